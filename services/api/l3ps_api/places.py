"""Answers that take long, such as streams and archives: how many there are at once, and whose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from l3ps_api.problems import fault


class Places:
    """The places of a process for one sort of answer. To be used in the event loop's thread.

    A project may hold as many as are still free: alone half of them, two that take what they can a third each. So
    whoever comes finds one, and with nobody else there is room to spare for one client's many.

    Args:
        limit: how many there are.
        code: of the problem that says there is none, in kebab-case.
        noun: what takes them, in the plural.
        remedy: what else a client can do.
    """

    def __init__(self, limit: int, code: str, noun: str, remedy: str) -> None:
        self._limit, self._code, self._noun, self._remedy = limit, code, noun, remedy
        self._held: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """How many are in use."""
        return self._held.total()

    @contextmanager
    def hold(self, project_id: str) -> Iterator[None]:
        """A place until the block ends; it is taken before anything else is done, so many at once get no more.

        Raises:
            ApiProblem: 429, the project has its share.
        """
        if self._held[project_id] >= self._limit - self.taken:
            what = f"the project has {self._held[project_id]} {self._noun} open, as many as this process has left"
            headers = {"Retry-After": "5"}
            raise fault(429, self._code, f"Too many {self._noun}", self._noun, what, self._remedy, headers)
        self._held[project_id] += 1
        try:
            yield
        finally:
            self._held[project_id] -= 1
            if not self._held[project_id]:
                del self._held[project_id]
