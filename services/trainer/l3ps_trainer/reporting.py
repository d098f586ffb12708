"""What a run tells while it works, and how it is asked to stop."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from l3ps.errors import Cancelled, InputError

EVERY = 0.25
"""Seconds between two lines of progress."""


class Reporter(Protocol):
    """Called by long work after each unit; raises :class:`~l3ps.errors.Cancelled` to stop it."""

    def __call__(self, step: str, done: int, total: int, **figures: float) -> None:
        """Report that ``done`` of ``total`` units of ``step`` are finished, and how it goes."""


def silent(step: str, done: int, total: int, **figures: float) -> None:
    """The reporter of a caller who does not want any."""


class Stop:
    """Whether a signal has asked the run to stop."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Signal handler: remember it; the second one of a kind ends the process the usual way."""
        self.signal = number
        signal.signal(number, signal.SIG_DFL)

    def check(self) -> None:
        """Raise Cancelled when a signal came."""
        if self.signal is not None:
            raise Cancelled(f"Stopped by {signal.Signals(self.signal).name}; the same command carries on from here.")


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Let SIGTERM and Ctrl-C end the block at the next unit of work, so that the checkpoint is written first."""
    stop = Stop()
    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Events:
    """One JSON object a line."""

    def __init__(self, stop: Stop, stream: TextIO | None = None) -> None:
        self._stop, self._stream, self._last = stop, stream or sys.stdout, 0.0

    def __call__(self, step: str, done: int, total: int, **figures: float) -> None:
        """A line, when the last one is old enough or the step is over."""
        self._stop.check()
        now = time.monotonic()
        if done >= total or now - self._last >= EVERY:
            self._last = now
            self.line(event="progress", step=step, done=done, total=total, figures=figures)

    def line(self, **content: Any) -> None:
        """Write one event."""
        self._stream.write(json.dumps(content) + "\n")
        self._stream.flush()

    def done(self, report: dict[str, Any]) -> None:
        """The run ended well."""
        self.line(event="done", report=report)

    def failed(self, error: InputError) -> None:
        """The input was at fault."""
        self.line(event="error", problems=[problem.as_dict() for problem in error.problems])


@contextmanager
def bars(stop: Stop, console: Console) -> Iterator[Reporter]:
    """A reporter that draws one bar a step, with the latest figures behind it."""
    columns = (
        TextColumn("{task.description:<10}"), BarColumn(24), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("{task.fields[figures]}"),
    )  # fmt: skip
    with Progress(*columns, console=console) as display:
        tasks: dict[str, TaskID] = {}

        def reporter(step: str, done: int, total: int, **figures: float) -> None:
            stop.check()
            if step not in tasks:
                tasks[step] = display.add_task(step, total=total, figures="")
            shown = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            display.update(tasks[step], completed=done, total=total)
            if shown:
                display.update(tasks[step], figures=shown)

        yield reporter
