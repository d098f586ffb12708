"""Running a bundle: one ONNX Runtime session on the CPU."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from l3ps.errors import ModelError, Problem
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.images import network_input
from l3ps.segment.panoptic import ClassScores, PanopticImage, fuse


class Segmenter:
    """A bundle ready to label images. Create it after a fork: the runtime's threads do not survive one.

    Args:
        bundle: the model.
        threads: threads inside one operator. 0 would mean every core of the machine, pinned and spinning, which
            starves neighbours in a container with a CPU limit, so it is refused.
        min_area: smallest object as a share of the image (see :func:`l3ps.segment.panoptic.fuse`).

    Raises:
        ModelError: when the graph cannot be loaded or its inputs and outputs are not those of ``model.json``.
    """

    def __init__(self, bundle: ModelBundle, threads: int = 2, min_area: float = 0.0) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, not {threads}")
        self.bundle = bundle
        self.min_area = min_area
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(bundle.graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises bare pybind exceptions without a common base
            raise _error(bundle, f"onnxruntime cannot load the graph ({_first_line(error)})") from error
        self._check_signature()

    def segment(self, image: NDArray[np.uint8]) -> PanopticImage:
        """Label one image.

        Args:
            image: (H, W, 3) uint8 RGB.

        Returns:
            Panoptic labels and class scores at the resolution of the network's output.
        """
        info = self.bundle.info
        names = [info.output.semantic] + ([info.output.boundary] if info.output.boundary else [])
        outputs = self._session.run(names, {info.input.name: network_input(image, info.input)})
        logits = outputs[0][0]
        if len(logits) != len(info.classes):
            raise _error(self.bundle, f"the output has {len(logits)} classes, model.json names {len(info.classes)}")
        semantic = info.lut[logits.argmax(axis=0)]
        interior = None
        if info.output.boundary:
            interior = _at_size(outputs[1][0, 0], semantic.shape) >= info.output.boundary_threshold
        labels = fuse(semantic, (image.shape[1], image.shape[0]), interior=interior, min_area=self.min_area)
        return replace(labels, scores=ClassScores(logits, info.lut))

    def _check_signature(self) -> None:
        info = self.bundle.info
        inputs = {i.name: i for i in self._session.get_inputs()}
        outputs = {o.name for o in self._session.get_outputs()}
        if info.input.name not in inputs:
            raise _error(self.bundle, f"the graph has no input '{info.input.name}' (it has {', '.join(inputs)})")
        for name in (info.output.semantic, info.output.boundary):
            if name and name not in outputs:
                raise _error(self.bundle, f"the graph has no output '{name}' (it has {', '.join(sorted(outputs))})")
        wanted = (1, 3, info.input.height, info.input.width)
        shape = inputs[info.input.name].shape
        fits = len(shape) == 4 and all(not isinstance(s, int) or s == w for s, w in zip(shape, wanted, strict=True))
        if not fits:
            raise _error(self.bundle, f"the graph takes {shape}, model.json says {list(wanted)}")


def _at_size(plane: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    if plane.shape == shape:
        return plane

    return np.asarray(cv2.resize(plane, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__


def _error(bundle: ModelBundle, what: str) -> ModelError:
    return ModelError(
        Problem("bad-graph", f"model '{bundle.info.name}'", what, "Export the model again, or correct model.json.")
    )
