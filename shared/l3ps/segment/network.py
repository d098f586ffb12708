"""One graph of a bundle in an ONNX Runtime session on the CPU."""

from __future__ import annotations

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from l3ps.errors import ModelError, Problem, first_line
from l3ps.segment.bundle import ModelBundle

CPU = ("CPUExecutionProvider",)


class Network:
    """A session that has been found to fit its description.

    Args:
        bundle: the model.
        preset: name of the segmentation preset whose graph to run.
        threads: threads inside one operator, the caller's included; None leaves the runtime all its defaults, to
            measure against.

    Raises:
        ModelError: when the bundle has no graph for the preset, the graph cannot be loaded, or its inputs and outputs
            are not those of ``model.json``.
    """

    def __init__(self, bundle: ModelBundle, preset: str, threads: int | None) -> None:
        graph, self.spec = bundle.graph_for(preset)
        self._bundle = bundle
        output = bundle.info.output
        self._names = [output.semantic] + ([output.boundary] if output.boundary else [])
        options = ort.SessionOptions()
        options.log_severity_level = 3
        if threads is not None:
            # By default it takes every core of the machine, pinned and spinning, which starves neighbours in a
            # container with a CPU limit.
            options.intra_op_num_threads = threads
            options.inter_op_num_threads = 1
            options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            if bundle.data:  # the weights' bytes: the runtime opens no file
                names = list(bundle.data)
                contents = list(bundle.data.values())
                options.add_external_initializers_from_files_in_memory(names, contents, [len(c) for c in contents])
            self.session = ort.InferenceSession(graph, options, providers=CPU)
        except Exception as error:  # onnxruntime raises bare pybind exceptions without a common base
            raise _error(bundle, f"onnxruntime cannot load the graph ({first_line(error)})") from error
        self._check_signature()

    def run(
        self, planes: NDArray[np.float32], options: ort.RunOptions | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """One pass; may be called from several threads at a time.

        Args:
            planes: (1, 3, height, width) float32, see :func:`l3ps.segment.images.network_input`.
            options: onnxruntime's; setting their ``terminate`` ends all passes that were given them.

        Returns:
            (C, h, w) float32 logits and (h', w') float32 probability of lying inside an object, None where the bundle
            has no boundary head.
        """
        try:
            outputs = self.session.run(self._names, {self._bundle.info.input.name: planes}, options)
        except Exception as error:  # onnxruntime raises bare pybind exceptions without a common base
            raise _error(self._bundle, f"it cannot run one image ({first_line(error)})") from error
        logits = outputs[0][0]
        classes = len(self._bundle.info.classes)
        if len(logits) != classes:
            raise _error(self._bundle, f"the output has {len(logits)} classes, model.json names {classes}")
        if not np.isfinite(logits).all():
            raise _error(self._bundle, f"output '{self._names[0]}' has values that are not finite")
        return logits, outputs[1][0, 0] if len(outputs) > 1 else None

    def _check_signature(self) -> None:
        info = self._bundle.info
        inputs = {i.name: i for i in self.session.get_inputs()}
        outputs = {o.name for o in self.session.get_outputs()}
        if info.input.name not in inputs:
            raise _error(self._bundle, f"the graph has no input '{info.input.name}' (it has {', '.join(inputs)})")
        for name in self._names:
            if name not in outputs:
                raise _error(self._bundle, f"the graph has no output '{name}' (it has {', '.join(sorted(outputs))})")
        wanted = (1, 3, self.spec.height, self.spec.width)
        shape = inputs[info.input.name].shape
        fits = len(shape) == 4 and all(not isinstance(s, int) or s == w for s, w in zip(shape, wanted, strict=True))
        if not fits:
            raise _error(self._bundle, f"the graph takes {shape}, model.json says {list(wanted)}")


def _error(bundle: ModelBundle, what: str) -> ModelError:
    return ModelError(
        Problem("bad-graph", f"model '{bundle.info.name}'", what, "Export the model again, or correct model.json.")
    )
