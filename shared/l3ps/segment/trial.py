"""The child process of :mod:`l3ps.segment.check`: reads a bundle and runs it, under limits of memory and time."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any


def main() -> None:
    """Answer the order in the first argument with one JSON object on standard output."""
    order = json.loads(sys.argv[1])
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    limit(order["memory"], order["seconds"])

    from l3ps.errors import ModelError, Problem  # noqa: PLC0415  (the limits come first)

    try:
        told = tried(Path(order["path"]), order["threads"])
    except ModelError as error:
        told = {"problems": [problem.as_dict() for problem in error.problems]}
    except MemoryError:
        what = f"it does not fit into {order['memory'] >> 20} MB"
        problem = Problem("model-failed-trial", order["path"], what, "Export a smaller model.")
        told = {"problems": [problem.as_dict()]}
    json.dump(told, answer)
    answer.close()
    os._exit(0)  # without the runtime's threads having a say


def limit(memory: int, seconds: float) -> None:
    """Have the kernel refuse more memory, time and written bytes, and take this process first when memory ends."""
    for kind, most in (
        (resource.RLIMIT_DATA, memory),
        (resource.RLIMIT_AS, memory + (4 << 30)),  # libraries are mapped, and that costs nothing
        (resource.RLIMIT_CPU, int(seconds * (os.cpu_count() or 1)) + 1),
        (resource.RLIMIT_FSIZE, 1 << 20),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # Who is out of time gets SIGXCPU at the soft limit, which tells it from who is killed for the machine's memory.
        most_ever = hard if kind == resource.RLIMIT_CPU else allowed
        with suppress(ValueError, OSError):
            resource.setrlimit(kind, (allowed, most_ever))
    if sys.platform == "linux":
        with suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000")
        ctypes.CDLL(None).prctl(1, int(signal.SIGKILL), 0, 0, 0)  # PR_SET_PDEATHSIG: no orphan


def tried(path: Path, threads: int) -> dict[str, Any]:
    """The content of a :class:`l3ps.segment.check.BundleReport`.

    Raises:
        ModelError: with every problem found.
    """
    from l3ps.errors import ModelError  # noqa: PLC0415
    from l3ps.segment.bundle import ModelBundle  # noqa: PLC0415
    from l3ps.segment.graphs import look  # noqa: PLC0415

    bundle = ModelBundle.load(path)
    presets = ["fast", *bundle.info.passes]
    looks = [look(bundle, preset) for preset in presets]
    problems = [problem for one in looks for problem in one.problems]
    if problems:
        raise ModelError(problems)
    graphs = [{**one.facts, **_passed(bundle, preset, threads)} for preset, one in zip(presets, looks, strict=True)]
    return {
        "name": bundle.info.name,
        "sha256": bundle.sha256,
        "label_space": bundle.info.label_space,
        "classes": list(bundle.info.classes),
        "boundary": bundle.info.output.boundary is not None,
        "graphs": graphs,
        "data": {name: len(content) for name, content in bundle.data.items()},
    }


def _passed(bundle: Any, preset: str, threads: int) -> dict[str, Any]:
    """Run one image of noise through a graph."""
    import numpy as np  # noqa: PLC0415

    from l3ps.errors import ModelError, Problem  # noqa: PLC0415
    from l3ps.segment.network import Network  # noqa: PLC0415

    network = Network(bundle, preset, threads)
    spec = network.spec
    noise = np.random.default_rng(0).random((1, 3, spec.height, spec.width), dtype=np.float32)
    noise *= 1 if spec.range == "0..1" else 255
    planes = (noise - np.reshape(spec.mean, (3, 1, 1))) / np.reshape(spec.std, (3, 1, 1))
    output, where = bundle.info.output, f"model '{bundle.info.name}'"
    remedy = "Export the model again, or correct model.json."
    start = time.perf_counter()
    logits, inside = network.run(planes.astype(np.float32))
    seconds = time.perf_counter() - start
    shapes = {output.semantic: np.asarray(logits)}
    if output.boundary:
        shapes[output.boundary] = np.asarray(inside)
    problems = []
    for name, plane in shapes.items():
        wanted = 3 if name == output.semantic else 2
        if plane.ndim != wanted or not plane.size or plane.dtype != np.float32:
            what = f"output '{name}' is no float32 image but {plane.dtype} of shape {plane.shape}"
            problems.append(Problem("bad-graph", where, what, remedy))
        elif not np.isfinite(plane).all():
            problems.append(Problem("bad-graph", where, f"output '{name}' has values that are not finite", remedy))
        elif name == output.boundary and not -0.001 <= plane.min() <= plane.max() <= 1.001:
            what = f"output '{name}' runs from {plane.min():.3g} to {plane.max():.3g} and is no probability"
            problems.append(Problem("bad-graph", where, what, "Export it with its sigmoid."))
    if problems:
        raise ModelError(problems)
    return {"seconds": seconds, "outputs": {name: list(plane.shape) for name, plane in shapes.items()}}


if __name__ == "__main__":
    main()
