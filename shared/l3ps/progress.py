"""Progress and cancellation as the method sees them: one callable, no queue, no terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Called by long work after each unit; may raise :class:`l3ps.errors.Cancelled` to stop it."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of ``stage`` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """The progress of a caller who does not want any."""


def track(items: Sequence[T], stage: str, progress: Progress) -> Iterator[T]:
    """Iterate over ``items`` and report each as done when the next one is asked for."""
    for done, item in enumerate(items, start=1):
        yield item
        progress(stage, done, len(items))
