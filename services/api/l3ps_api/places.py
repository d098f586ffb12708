"""What a process has few of, shared between projects: places for answers that take long, and turns at the work.

A project may hold as many as are still free: alone half of them, two that take what they can a third each. So whoever
comes finds one, and with nobody else there is room to spare for one client's many. All of it belongs to the event
loop's thread.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from l3ps_api.limits import too_many
from l3ps_api.problems import fault


class Shares:
    """Who holds how many.

    Args:
        limit: how many there are.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._held: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """How many are in use."""
        return self._held.total()

    def of(self, project_id: str) -> int:
        """How many a project holds."""
        return self._held[project_id]

    def take(self, project_id: str) -> bool:
        """Take one, if the project may have another."""
        if self._held[project_id] >= self._limit - self.taken:
            return False
        self._held[project_id] += 1
        return True

    def give_back(self, project_id: str) -> None:
        """One fewer."""
        self._held[project_id] -= 1
        if not self._held[project_id]:
            del self._held[project_id]


class Places:
    """Places for one sort of answer, such as streams and archives; more are refused.

    Args:
        limit: how many there are.
        code: of the problem that says there is none, in kebab-case.
        noun: what takes them, in the plural.
        remedy: what else a client can do.
    """

    def __init__(self, limit: int, code: str, noun: str, remedy: str) -> None:
        self._shares = Shares(limit)
        self._code, self._noun, self._remedy = code, noun, remedy

    @property
    def taken(self) -> int:
        """How many are in use."""
        return self._shares.taken

    @contextmanager
    def hold(self, project_id: str) -> Iterator[None]:
        """A place until the block ends; it is taken before anything else is done, so many at once get no more.

        Raises:
            ApiProblem: 429, the project has its share.
        """
        if not self._shares.take(project_id):
            what = f"the project has {self._shares.of(project_id)} {self._noun} open, as many as this process has left"
            headers = {"Retry-After": "5"}
            raise fault(429, self._code, f"Too many {self._noun}", self._noun, what, self._remedy, headers)
        try:
            yield
        finally:
            self._shares.give_back(project_id)


class Turns:
    """Turns at the threads that do the work; more wait, each project's in a line of its own.

    A key's rate counts requests, and one may cost a hundred times what another does. Without turns the threads, and
    the interpreter's lock, were all one project's that asked for its largest lists as often as it may.

    Args:
        limit: how many there are.
        waiting: requests of a project that may wait.
        waiting_bytes: those of their bodies together.
    """

    def __init__(self, limit: int, waiting: int, waiting_bytes: int) -> None:
        self._shares, self._most, self._most_bytes = Shares(limit), waiting, waiting_bytes
        self._bytes: Counter[str] = Counter()
        self._lines: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    @asynccontextmanager
    async def turn(self, project_id: str, size: int = 0) -> AsyncIterator[None]:
        """Wait for a turn, and have it until the block ends.

        Args:
            project_id: whose.
            size: of the request's body, bytes.

        Raises:
            ApiProblem: 429, too many wait already.
        """
        if project_id in self._lines or not self._shares.take(project_id):
            await self._wait(project_id, size)
        try:
            yield
        finally:
            self._shares.give_back(project_id)
            self._call()

    async def _wait(self, project_id: str, size: int) -> None:
        line = self._lines.get(project_id, deque())
        # The first may wait, however large: it is not refused what nobody else has.
        if len(line) >= self._most or (line and self._bytes[project_id] + size > self._most_bytes):
            raise too_many(1, f"{len(line)} requests of this project wait already")
        mine = asyncio.get_running_loop().create_future()
        self._lines[project_id] = line
        line.append(mine)
        self._bytes[project_id] += size
        try:
            await mine
        except asyncio.CancelledError:
            if not mine.cancelled():  # called in this moment
                self._shares.give_back(project_id)
            self._call()
            raise
        finally:
            self._bytes[project_id] -= size
            if not self._bytes[project_id]:
                del self._bytes[project_id]

    def _call(self) -> None:
        """Have those who may go on: the projects' first, in turn."""
        for project_id in list(self._lines):
            line = self._lines[project_id]
            while line and line[0].done():  # cancelled
                line.popleft()
            if line and self._shares.take(project_id):
                line.popleft().set_result(None)
                self._lines.move_to_end(project_id)
            if not line:
                del self._lines[project_id]
