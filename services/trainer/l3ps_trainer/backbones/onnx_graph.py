"""Any ONNX graph that returns a feature map, as a frozen backbone."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from pydantic import ValidationError
from torch import Tensor

from l3ps.errors import ModelError, Problem, first_line
from l3ps.segment.bundle import InputSpec

from ..runtime import session_of
from .base import Backbone, input_spec

STRETCHED = 1.5
"""How far a graph may change an image's aspect. Fine features matter more: 4:3 images of CamVid stretched to 1024×512
reached 6 mIoU more than at 512×384 in one fold of cross-validation."""
_REMEDY = "Name a graph that takes one image (1, 3, H, W) and returns one feature map (1, D, h, w), all sizes fixed."


@dataclass(frozen=True)
class _Graph:
    """One file: its input and the shape of its feature map."""

    path: Path
    image: str
    output: str
    size: tuple[int, int]
    channels: int
    stride: int


class OnnxGraph(Backbone):
    """A graph run by ONNX Runtime on the CPU.

    Args:
        path: of one graph, or of a folder of graphs of several sizes.
        size: (height, width) wanted, or None for the largest graph that stretches images by no more than
            :data:`STRETCHED`, or where there is none, the one whose aspect comes nearest to ``aspect``.
        aspect: width / height of the images.
        threads: of one operator.

    Raises:
        ModelError: there is no such graph, or it returns no feature map.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None, aspect: float = 16 / 9, threads: int = 2) -> None:
        super().__init__()
        self._path, self._threads = path, threads
        chosen = _chosen(_graphs(path), size, aspect)
        self.name = f"onnx:{path.name}/{chosen.path.name}" if path.is_dir() else f"onnx:{path.name}"
        self.file, self.output, self.channels, self.stride = chosen.path, chosen.output, chosen.channels, chosen.stride
        self.spec = _spec(chosen)
        self.identity = hashlib.sha256(chosen.path.read_bytes()).hexdigest()
        try:
            self._session = session_of(chosen.path, threads)
        except Exception as error:  # onnxruntime raises bare pybind exceptions without a common base
            raise _wrong(chosen.path, f"onnxruntime cannot load it ({first_line(error)})") from error
        self._try(chosen)

    def _try(self, graph: _Graph) -> None:
        """Refuse a graph whose features are not those that it declares."""
        grey = np.full((1, 3, *graph.size), 0.1, dtype=np.float32)
        try:
            (features,) = self._session.run([graph.output], {graph.image: grey})
        except Exception as error:  # onnxruntime raises bare pybind exceptions without a common base
            raise _wrong(graph.path, f"it cannot be run ({first_line(error)})") from error
        if features.dtype != np.float32 or features.shape[:2] != (1, graph.channels) or features.ndim != 4:
            raise _wrong(graph.path, f"it returns {features.dtype} {list(features.shape)} and declares otherwise")
        if not np.isfinite(features).all():
            raise _wrong(graph.path, "it returns numbers that are not finite for a grey image")

    def forward(self, images: Tensor) -> Tensor:
        single = images.detach().cpu().numpy()
        maps = [self._session.run([self.output], {self.spec.name: image[None]})[0] for image in single]
        return torch.from_numpy(np.concatenate(maps)).to(images.device)

    def check(self, size: tuple[int, int], option: str = "--size") -> None:
        """Refuse an input of which there is no graph."""
        _chosen(_graphs(self._path), size, 1.0, option)

    def at(self, size: tuple[int, int]) -> OnnxGraph:
        """The graph of the same folder that has this input."""
        return OnnxGraph(self._path, size, threads=self._threads)


def _graphs(path: Path) -> list[_Graph]:
    files = sorted(path.glob("*.onnx")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise _wrong(path, "there is no ONNX graph")
    return [_read(file) for file in files]


def _read(file: Path) -> _Graph:
    try:
        graph = onnx.load(file, load_external_data=False).graph
    except Exception as error:  # protobuf raises its own kinds
        raise _wrong(file, "it is no ONNX graph") from error
    weights = {tensor.name for tensor in graph.initializer}
    inputs = [i for i in graph.input if i.name not in weights]
    shapes = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*inputs, *graph.output)]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise _wrong(file, f"it has {len(inputs)} inputs and {len(graph.output)} outputs")
    image, features = shapes
    if len(image) != 4 or image[:2] != [1, 3] or min(image) < 1:
        raise _wrong(file, f"its input is {image}")
    if len(features) != 4 or features[0] != 1 or min(features) < 1:
        raise _wrong(file, f"its output is {features}")
    return _Graph(
        file,
        inputs[0].name,
        graph.output[0].name,
        (image[2], image[3]),
        features[1],
        max(1, round(image[3] / features[3])),
    )


def _chosen(graphs: list[_Graph], size: tuple[int, int] | None, aspect: float, option: str | None = None) -> _Graph:
    if size is None:
        bent = {g.path: round(abs(float(np.log(g.size[1] / g.size[0] / aspect))), 2) for g in graphs}
        fitting = [g for g in graphs if bent[g.path] <= round(float(np.log(STRETCHED)), 2)]
        if fitting:
            return max(fitting, key=lambda g: (g.size[0] * g.size[1], -bent[g.path]))
        return min(graphs, key=lambda g: (bent[g.path], g.size))
    for graph in graphs:
        if graph.size == size:
            return graph
    known = ", ".join(f"{g.size[0]}x{g.size[1]}" for g in graphs)
    what = f"there is no graph for an input of {size[0]}x{size[1]}"
    raise ModelError(Problem("bad-size", option or str(graphs[0].path.parent), what, f"There are: {known}."))


def _spec(graph: _Graph) -> InputSpec:
    """ImageNet's normalisation, unless the JSON beside the graph says otherwise."""
    usual = input_spec(graph.size).model_copy(update={"name": graph.image})
    beside = graph.path.with_suffix(".json")
    if not beside.is_file():
        return usual
    try:
        told = json.loads(beside.read_text())
        return InputSpec.model_validate(
            usual.model_dump() | {k: told[k] for k in ("mean", "std", "range") if k in told}
        )
    except (ValueError, TypeError, ValidationError) as error:
        what = f"it does not tell mean, std and range ({' '.join(str(error).split())[:160]})"
        raise ModelError(Problem("bad-model-json", str(beside), what, "Correct or remove the file.")) from error


def _wrong(path: Path, what: str) -> ModelError:
    return ModelError(Problem("bad-backbone", str(path), what, _REMEDY))
