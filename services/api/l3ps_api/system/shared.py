"""One answer for all who ask at the same time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from anyio import CapacityLimiter, to_thread

Answer = TypeVar("Answer")

_PAUSE = 2.0
_LONGEST_PAUSE = 1.0


class Shared(Generic[Answer]):
    """Makes an answer once at a time, in a thread of its own, however many ask for it.

    Whoever asks gets an answer that was begun after the question, with all others who wait for it. Between two there is
    a pause of twice the time that the last one took, a second at most: anybody may ask, and so may use a third of a
    thread and no more.

    Args:
        make: what answers; what it raises, all who wait are told.
    """

    def __init__(self, make: Callable[[], Answer]) -> None:
        self._make, self._limiter = make, CapacityLimiter(1)
        self._running: asyncio.Task[Answer] | None = None
        self._waiting: asyncio.Task[Answer] | None = None
        self._not_before = 0.0

    async def get(self) -> Answer:
        """The next answer."""
        if self._waiting is None:
            self._waiting = asyncio.create_task(self._next(self._running))
            self._waiting.add_done_callback(_look_at)
        return await asyncio.shield(self._waiting)  # one who goes leaves it to the others

    async def _next(self, before: asyncio.Task[Answer] | None) -> Answer:
        if before is not None:
            await asyncio.wait({before})
        await asyncio.sleep(max(0.0, self._not_before - time.monotonic()))
        self._running, self._waiting = self._waiting, None
        begun = time.monotonic()
        try:
            return await to_thread.run_sync(self._make, limiter=self._limiter)
        finally:
            took = time.monotonic() - begun
            self._not_before = begun + took + min(_PAUSE * took, _LONGEST_PAUSE)
            self._running = None


def _look_at(task: asyncio.Task[Answer]) -> None:
    """Else asyncio complains of an error that nobody waited for."""
    if not task.cancelled():
        task.exception()
