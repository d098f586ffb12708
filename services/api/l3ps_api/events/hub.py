"""One look at the catalog for all who listen.

While anybody listens, a poller asks the log twice a second what is new and, for the jobs that are watched, how far they
are: a few queries, however many listeners there are, and none when nobody listens. The newest events stay in a ring
that all streams read at their own pace; a stream that falls behind it goes on from the log itself. So a slow client
costs a place in the log and no memory, and misses nothing.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import structlog
from anyio import CapacityLimiter
from fastapi.concurrency import run_in_threadpool

from l3ps_api.places import Places
from l3ps_platform.catalog import Catalog, EventRow, events, watching
from l3ps_platform.errors import PlatformError

log = structlog.get_logger(__name__)

TICK_SECONDS = 0.5
RING = 2000
PAGE = 500
_READERS = 4
"""Streams that read the log at once, in threads of their own: while the catalog does not answer, they hold no more."""
_REMEDY = "Close some, follow the project by one stream, or ask for the jobs' states instead."


@dataclass(frozen=True, slots=True)
class Entry:
    """An event as streams need it; ``text`` is its document, rendered once for all of them."""

    seq: int
    project_id: str
    kind: str
    subject_id: str
    text: str

    @classmethod
    def of(cls, row: EventRow) -> Entry:
        """The same event from its row."""
        document = {
            "seq": row.seq,
            "type": row.kind,
            "timestamp": row.created_at.isoformat().replace("+00:00", "Z"),
            "subject": row.subject_id,
            "data": row.data,
        }
        return cls(row.seq, row.project_id, row.kind, row.subject_id, json.dumps(document, ensure_ascii=False))


class EventHub:
    """What is new, for the streams of this process. To be used in the event loop's thread.

    Attributes:
        base: events up to this number are no longer in the ring, or never were; -1 while nothing is known yet.
        head: events up to this number are in the log or the ring; -1 while nothing is known yet.
        listeners: how many streams there are.
        closing: the process stops and so shall the streams.
        readers: who may read the log at once.
        places: those of the streams.
    """

    def __init__(self, catalog: Catalog, limit: int = 500) -> None:
        self._catalog = catalog
        self.readers = CapacityLimiter(_READERS)
        self.places = Places(limit, "too-many-streams", "streams", _REMEDY)
        self._ring: deque[Entry] = deque()
        self._watched: Counter[str] = Counter()
        self._progress: dict[str, str] = {}
        self._news = asyncio.Event()
        self._poller: asyncio.Task[None] | None = None
        self.base = self.head = -1
        self.listeners = 0
        self.closing = False

    @asynccontextmanager
    async def listening(self, job_id: str | None = None) -> AsyncIterator[None]:
        """Count as a listener, who also wants to know how far a job is."""
        self.listeners += 1
        if job_id is not None:
            self._watched[job_id] += 1
        if self._poller is None:
            self._poller = asyncio.create_task(self._poll())
        try:
            yield
        finally:
            self.listeners -= 1
            if job_id is not None:
                self._watched[job_id] -= 1
                if not self._watched[job_id]:
                    del self._watched[job_id]
                    self._progress.pop(job_id, None)
            if not self.listeners:
                self._rest()

    @property
    def news(self) -> asyncio.Event:
        """Set when there is something new; to be taken before looking, and awaited after."""
        return self._news

    def since(self, seq: int) -> list[Entry]:
        """The events in the ring after a number, in order."""
        newer: list[Entry] = []
        for entry in reversed(self._ring):
            if entry.seq <= seq:
                break
            newer.append(entry)
        return newer[::-1]

    def progress(self, job_id: str) -> str | None:
        """How far a watched job is, as JSON; None before it is known."""
        return self._progress.get(job_id)

    def close(self) -> None:
        """End all streams: the process stops, and its clients go on at another one or later."""
        self.closing = True
        self._tell()

    async def _poll(self) -> None:
        troubled = False
        while True:
            full = False
            try:
                full = await self._look()
                troubled = False
            except PlatformError as error:
                if not troubled:
                    log.warning("events wait", reason=str(error))
                troubled = True
            except Exception:
                log.exception("looking for events failed")
            if not full:
                await asyncio.sleep(TICK_SECONDS)

    async def _look(self) -> bool:
        """One look; whether there is more to fetch at once."""
        watched = list(self._watched)
        fresh, head, progress = await run_in_threadpool(self._fetch, self.head, watched)
        if self.head < 0:
            self.base = head
        for entry in fresh:
            self._ring.append(entry)
            if len(self._ring) > RING:
                self.base = self._ring.popleft().seq
        known = {id: text for id, text in progress.items() if id in self._watched}
        if head != self.head or known != self._progress:
            self.head, self._progress = head, known
            self._tell()
        return len(fresh) == PAGE

    def _fetch(self, head: int, watched: list[str]) -> tuple[list[Entry], int, dict[str, str]]:
        with self._catalog.reading() as session:
            fresh = [] if head < 0 else [Entry.of(row) for row in events.after(session, head, limit=PAGE)]
            head = events.last_seq(session) if head < 0 else fresh[-1].seq if fresh else head
            found = watching.progress(session, watched) if watched else {}
        return fresh, head, {id: json.dumps(document, ensure_ascii=False) for id, document in found.items()}

    def _rest(self) -> None:
        if self._poller is not None:
            self._poller.cancel()
            self._poller = None
        self._ring.clear()
        self.base = self.head = -1

    def _tell(self) -> None:
        news, self._news = self._news, asyncio.Event()
        news.set()
