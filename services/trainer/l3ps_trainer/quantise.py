"""int8 weights for the matrix products of a transformer (FIELD-NOTES of ONNX Runtime: convolutions only lose by it)."""

from __future__ import annotations

import logging
from pathlib import Path

KEPT_WITHIN = 0.5
"""Points of validation mIoU that int8 may cost; a graph that costs more is not delivered."""


def quantise(graph: Path, target: Path) -> None:
    """Write the graph with int8 weights in every product with a constant matrix; activations are scaled as they come.

    Args:
        graph: float32.
        target: where to.
    """
    from onnxruntime.quantization import QuantType, quantize_dynamic  # noqa: PLC0415  (slow to import, seldom used)

    logging.getLogger().setLevel(logging.ERROR)  # it recommends a preparation that changes nothing here
    quantize_dynamic(graph, target, op_types_to_quantize=["MatMul"], per_channel=True, weight_type=QuantType.QInt8)
