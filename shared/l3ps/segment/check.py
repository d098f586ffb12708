"""Whether a bundle can be trusted with images: looked at and tried in a process of its own.

A graph is a program from a stranger. It may ask for 100 GB, run for ever or crash the runtime, so everything that
reads it happens in a child (:mod:`l3ps.segment.trial`) with a limit of memory and time, whose end is an answer too:
that of a model at fault, or of a machine that had too little for any.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pydantic import BaseModel

from l3ps.errors import ModelError, Problem, ProcessingError, Starved
from l3ps.progress import Progress, silent

MEMORY = 8 << 30
"""Bytes that one image may take, beside four times the bundle: a ViT-B on 896×1596 pixels takes 5 GB."""
SECONDS = 300.0
"""A ViT-g takes a minute an image on two cores."""
_POLL = 0.2
_SHARE = 0.5
"""Of one processor: a trial that had less in its time was waiting for others."""
_PATIENCE = 4
"""How many times its time such a trial may wait."""
_ENDED_FROM_OUTSIDE = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class GraphReport(BaseModel):
    """What is in one graph."""

    preset: str
    file: str
    bytes: int
    opset: int
    nodes: int
    int8: bool
    input: list[int]
    outputs: dict[str, list[int]]
    """Name → shape, as the trial gave it."""
    seconds: float
    """Of one pass."""


class BundleReport(BaseModel):
    """What is in a bundle that passed."""

    name: str
    sha256: str
    label_space: str
    classes: list[str]
    boundary: bool
    graphs: list[GraphReport]
    data: dict[str, int]
    """File with weights → bytes."""


def check_bundle(
    path: Path,
    *,
    threads: int = 2,
    memory: int = MEMORY,
    seconds: float = SECONDS,
    progress: Progress = silent,
) -> BundleReport:
    """Look at a bundle and run one image through each of its graphs.

    Args:
        path: directory or zip.
        threads: that the trial may use.
        memory: bytes that the trial may take, beside four times the bundle's size.
        seconds: that it may take, up to four times as long where it gets less than half a processor.
        progress: called while it runs; may raise ``Cancelled``, which ends it.

    Raises:
        ModelError: with every problem found.
        Starved: the machine has too little memory for the trial, or no processor time.
        ProcessingError: when the check itself does not work.
    """
    path = Path(path)
    held = sum(p.stat().st_size for p in path.iterdir() if p.is_file()) if path.is_dir() else 0
    held = held or (path.stat().st_size if path.is_file() else 0)
    order = {"path": str(path), "threads": threads, "memory": memory + 4 * held, "seconds": seconds}
    environment = os.environ | {"OPENBLAS_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as complaint:
        child = subprocess.Popen(
            [sys.executable, "-m", "l3ps.segment.trial", json.dumps(order)],
            stdin=subprocess.DEVNULL,
            stdout=answer,
            stderr=complaint,
            env=environment,
        )
        try:
            code = _wait(child, seconds, progress)
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        answer.seek(0)
        complaint.seek(0)
        return _read(path, code, answer.read(), complaint.read(), order)


def _wait(child: subprocess.Popen[bytes], seconds: float, progress: Progress) -> int | None:
    """Exit code; None when the time ran out."""
    begun = time.monotonic()
    while (waited := time.monotonic() - begun) < _PATIENCE * seconds:
        if waited >= seconds and _cpu_seconds(child.pid) >= _SHARE * seconds:
            return None
        progress("check", 0, 1)
        try:
            return child.wait(_POLL)
        except subprocess.TimeoutExpired:
            continue
    raise Starved(f"the trial of the model had hardly any processor time in {waited:.0f} s: try it again later", "time")


def _cpu_seconds(pid: int) -> float:
    """Processor time of a process. Infinite where the system does not tell: then only the clock on the wall counts."""
    try:
        ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    except OSError:
        return math.inf
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def _read(path: Path, code: int | None, answer: bytes, complaint: bytes, order: dict[str, object]) -> BundleReport:
    if code == 0:
        told = json.loads(answer)
        if "problems" in told:
            raise ModelError(Problem(**problem) for problem in told["problems"])
        return BundleReport.model_validate(told)
    if code is not None and code > 0:
        last = complaint.decode("utf-8", "replace").strip().rpartition("\n")[2]
        raise ProcessingError(f"The check of the model did not work: {last[:300] or f'exit code {code}'}")
    if code == -signal.SIGKILL:  # not by its limits: what asks for more memory is refused it, and the time is not over
        raise Starved("the trial of the model was killed: free memory on this machine, or use one with more", "memory")
    if code is not None and -code in _ENDED_FROM_OUTSIDE:
        raise Starved(f"the trial of the model was stopped by {signal.Signals(-code).name}: try it again", "time")
    ended = f"was ended by {signal.Signals(-code).name}" if code else f"took more than {order['seconds']:.0f} s"
    what = f"its trial on one image {ended}; it may take {int(str(order['memory'])) >> 20} MB"
    remedy = "Export a smaller model, or one for a smaller input."
    raise ModelError(Problem("model-failed-trial", str(path), what, remedy))
