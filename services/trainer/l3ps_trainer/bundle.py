"""A trained network as a model bundle: model.onnx, model.json, and the proof that both runtimes agree."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from l3ps.taxonomy import NUSCENES16

from .network import PanopticNet
from .samples import MEAN, STD

CLASSES = (*NUSCENES16.classes, "sky")
"""Void, the sixteen classes, sky."""
TOLERANCE = 1e-3
"""Largest difference between torch and ONNX Runtime that is still rounding, in logits of order 10."""


def describe(name: str, size: tuple[int, int], boundary_threshold: float) -> dict[str, object]:
    """The content of ``model.json``.

    Args:
        name: of the model.
        size: (height, width) of its input.
        boundary_threshold: value of the boundary map under which a pixel separates two segments.
    """
    return {
        "name": name,
        "label_space": "nuscenes",
        "input": {"name": "image", "height": size[0], "width": size[1], "range": "0..1", "mean": MEAN, "std": STD},
        "output": {"semantic": "semantic", "boundary": "boundary", "boundary_threshold": boundary_threshold},
        "classes": list(CLASSES),
        "to_nuscenes": {c: index if index < len(NUSCENES16.classes) else 0 for index, c in enumerate(CLASSES)},
    }


def export(network: PanopticNet, folder: Path, name: str, size: tuple[int, int], boundary_threshold: float) -> float:
    """Write the bundle and compare both runtimes on a random image.

    Args:
        network: trained, in evaluation mode.
        folder: where to; made when missing.
        name: of the model.
        size: (height, width) of the input, multiples of 16.
        boundary_threshold: see :func:`describe`.

    Returns:
        The largest absolute difference of any output.

    Raises:
        RuntimeError: the runtimes differ by more than :data:`TOLERANCE`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "model.onnx"
    image = torch.rand((1, 3, *size), generator=torch.Generator().manual_seed(0)) * 4 - 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns about its own use of torch
        torch.onnx.export(
            network, (image,), str(path), input_names=["image"], output_names=["semantic", "boundary"], dynamo=True,
            external_data=False, verbose=False,
        )  # fmt: skip
    _strip(path)
    text = json.dumps(describe(name, size, boundary_threshold), indent=2)
    (folder / "model.json").write_text(text + "\n")

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = [output.numpy() for output in network(image)]
    found = session.run(["semantic", "boundary"], {"image": image.numpy()})
    difference = max(float(np.abs(a - b).max()) for a, b in zip(expected, found, strict=True))
    if difference > TOLERANCE:
        raise RuntimeError(f"{path} differs from the trained network by {difference:.2g}; more than {TOLERANCE:.0e}")
    return difference


def _strip(path: Path) -> None:
    """Drop what the exporter notes down for its own authors: stack traces with the paths of this machine."""
    model = onnx.load(path)
    graph = model.graph
    for noted in (model, graph, *graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del noted.metadata_props[:]
        noted.doc_string = ""
    onnx.save(model, path)
