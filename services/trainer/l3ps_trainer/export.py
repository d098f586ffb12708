"""A trained network as one ONNX graph for both heads, and the proof that both runtimes agree."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import compose, version_converter
from torch import Tensor, nn

from l3ps.errors import ProcessingError

from .backbones import Backbone, DinoV2, OnnxGraph
from .backbones.dinov2 import runtime_attention
from .commute import convolve_before_enlarging
from .heads import Heads
from .runtime import session_of

OPSET = 18
LARGEST_FILE = 1 << 30
"""Bytes of weights in the graph's own file; a protobuf ends at 2 GB, so more go into a file beside it."""
PROBABILITY_TOLERANCE = 1e-3
LEAST_EQUAL = 0.999
"""Share of pixels at which both runtimes must choose the same class."""


@dataclass(frozen=True)
class Agreement:
    """How far torch and ONNX Runtime agree.

    Attributes:
        probability: largest difference of any class probability or boundary value.
        equal: share of pixels with the same most probable class.
        images: how many were compared.
    """

    probability: float
    equal: float
    images: int


class Network(nn.Module):
    """Backbone and heads as the bundle carries them.

    Void is never taught, so its logit means nothing and is left out.

    Args:
        backbone: frozen or trained.
        heads: trained; put in their exported form.
        keep_void: leave the first class in; for networks that were taught it.
    """

    def __init__(self, backbone: Backbone, heads: Heads, *, keep_void: bool = False) -> None:
        super().__init__()
        self.backbone, self.heads, self.first = backbone, heads.for_export(), 0 if keep_void else 1
        self.eval()

    def outputs(self) -> list[str]:
        """Names of the graph's outputs."""
        return ["semantic", "boundary"] if self.heads.boundary is not None else ["semantic"]

    def labelled(self, features: Tensor) -> tuple[Tensor, ...]:
        """(B, C, h, w) class logits and, with a boundary head, (B, 1, h', w') probability of lying inside a segment."""
        semantic, boundary = self.heads(features)
        semantic = semantic[:, self.first :]
        return (semantic,) if boundary is None else (semantic, torch.sigmoid(boundary))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return self.labelled(self.backbone(images))


class _OnFeatures(nn.Module):
    """A network without its backbone."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.heads, self.network = network.heads, (network,)  # in a tuple: the backbone is no part of this module

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        return self.network[0].labelled(features)


def write_graph(network: Network, path: Path) -> None:
    """Write the ONNX graph, and for giants a file of weights ``<name>.data`` beside it.

    Args:
        network: to export.
        path: of the graph.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = network.backbone.spec
    if isinstance(network.backbone, OnnxGraph):
        onnx.save(_merged(network, network.backbone), path)
        return
    size = sum(p.numel() * p.element_size() for p in network.parameters())
    with runtime_attention(network.backbone) if isinstance(network.backbone, DinoV2) else nullcontext():
        _trace(network, torch.zeros((1, 3, spec.height, spec.width)), spec.name, network.outputs(), path, size)


def agreement(network: Network, path: Path, inputs: Sequence[NDArray[np.float32]], threads: int = 2) -> Agreement:
    """Compare both runtimes.

    Args:
        network: as in torch.
        path: of its graph.
        inputs: each (1, 3, H, W), normalised.
        threads: of ONNX Runtime.

    Raises:
        ProcessingError: they differ by more than rounding.
    """
    session = session_of(path, threads)
    worst, equal = 0.0, 0.0
    for image in inputs:
        with torch.no_grad():
            expected = [o.numpy() for o in network(torch.from_numpy(image))]
        found = session.run(network.outputs(), {network.backbone.spec.name: image})
        difference = np.abs(_softmax(expected[0]) - _softmax(found[0])).max()
        if len(found) > 1:
            difference = max(difference, np.abs(expected[1] - found[1]).max())
        worst = max(worst, float(difference))
        equal += float((expected[0].argmax(1) == found[0].argmax(1)).mean()) / len(inputs)
    if worst > PROBABILITY_TOLERANCE or equal < LEAST_EQUAL:
        raise ProcessingError(
            f"{path.name} is not the network that was trained: probabilities differ by up to {worst:.1e} and "
            f"{100 * equal:.2f} % of the pixels get the same class; nothing was delivered"
        )
    return Agreement(worst, equal, len(inputs))


def _softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    scores = np.exp(logits - logits.max(axis=1, keepdims=True))
    return cast(NDArray[np.float32], scores / scores.sum(axis=1, keepdims=True))


def _trace(module: nn.Module, example: Tensor, name: str, outputs: list[str], path: Path, weights: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns about its own use of torch
        torch.onnx.export(
            module, (example,), str(path), input_names=[name], output_names=outputs, dynamo=True, opset_version=OPSET,
            external_data=weights > LARGEST_FILE, verbose=False,
        )  # fmt: skip
    model = onnx.load(path, load_external_data=False)
    _strip(model)
    onnx.save(model, path)


def _merged(network: Network, backbone: OnnxGraph) -> onnx.ModelProto:
    """The user's graph with the heads grown on its feature map."""
    base = onnx.load(backbone.file)
    with torch.no_grad():
        features = backbone(torch.zeros((1, 3, backbone.spec.height, backbone.spec.width)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "heads.onnx"
        _trace(_OnFeatures(network), features, "features", network.outputs(), path, 0)
        heads = onnx.load(path)
    # One file has one version of the operators: the higher of both.
    version = max(_opset(base), _opset(heads))
    base, heads = (m if _opset(m) == version else version_converter.convert_version(m, version) for m in (base, heads))
    base.ir_version = heads.ir_version = max(base.ir_version, heads.ir_version)
    _strip(base)
    merged = compose.merge_models(
        compose.add_prefix(base, "backbone/", rename_inputs=False, rename_outputs=True),
        compose.add_prefix(heads, "heads/", rename_inputs=True, rename_outputs=False),
        io_map=[(f"backbone/{backbone.output}", "heads/features")],
    )
    domains = {o.domain: o.version for o in merged.opset_import}  # merging lists a domain of both twice
    del merged.opset_import[:]
    merged.opset_import.extend(onnx.helper.make_opsetid(domain, opset) for domain, opset in domains.items())
    convolve_before_enlarging(merged, f"backbone/{backbone.output}")
    onnx.checker.check_model(merged)
    return merged


def _opset(model: onnx.ModelProto) -> int:
    return next(int(o.version) for o in model.opset_import if o.domain in ("", "ai.onnx"))


def _strip(model: onnx.ModelProto) -> None:
    """Drop what the exporter notes down for its own authors: stack traces with the paths of this machine."""
    graph = model.graph
    for noted in (model, graph, *graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del noted.metadata_props[:]
        noted.doc_string = ""
