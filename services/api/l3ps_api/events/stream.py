"""A stream of server-sent events: what was missed, then what happens, and signs of life in between."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import structlog
from anyio import to_thread
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from l3ps_api.events.hub import PAGE, Entry, EventHub
from l3ps_platform.catalog.kinds import JOB_OVER
from l3ps_platform.errors import PlatformError

log = structlog.get_logger(__name__)

HEARTBEAT_SECONDS = 15.0
RETRY_MS = 2000
LIFE_SECONDS = 900.0
"""A stream lives no longer: whose key was revoked meanwhile does not come back, others go on where they were."""
PIECE = 1 << 16
"""Bytes of an opening that are handed on at a time: what a slow client has not taken yet is not copied."""


@dataclass(frozen=True, slots=True)
class Feed:
    """What one client is to be told.

    Attributes:
        cursor: everything up to this number is known to it.
        read: fetches the events after a number from the log, at most ``PAGE``, only those it wants.
        wants: whether it wants an event of the ring.
        job_id: the job whose progress it is shown, and with whose end the stream ends.
        opening: what it is sent first, in parts.
        over: there is nothing to follow.
    """

    cursor: int
    read: Callable[[int], list[Entry]]
    wants: Callable[[Entry], bool]
    job_id: str | None = None
    opening: tuple[bytes, ...] = ()
    over: bool = False


class EventStream(StreamingResponse):
    """The answer: never kept by anyone on the way.

    Not FastAPI's class of this purpose, which wants routes that yield: ours says before the stream begins whether there
    is one.
    """

    media_type = "text/event-stream"

    def __init__(self, content: AsyncIterator[bytes]) -> None:
        super().__init__(content, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})


async def told(hub: EventHub, feed: Feed) -> AsyncIterator[bytes]:
    """The stream's bytes. Ends with the job, in good time, when the process stops, or when the log cannot be read."""
    yield format_sse_event(retry=RETRY_MS)
    for part in feed.opening:
        for at in range(0, len(part), PIECE):
            yield part[at : at + PIECE]
    feed, part = replace(feed, opening=()), b""  # held no longer than it takes to send
    if feed.over:
        return
    cursor, shown = feed.cursor, None
    clock = asyncio.get_running_loop().time
    last_sent = clock()
    ends = last_sent + LIFE_SECONDS
    async with hub.listening(feed.job_id):
        while not hub.closing and clock() < ends:
            news = hub.news
            try:
                found, cursor, more = await _after(hub, feed, cursor)
            except PlatformError as error:
                log.info("stream ended, the client will come back", reason=str(error))
                return
            pieces = [format_sse_event(event=entry.kind, data_str=entry.text, id=str(entry.seq)) for entry in found]
            over = feed.job_id is not None and bool(found) and found[-1].kind in JOB_OVER
            progress = None if feed.job_id is None or over or more else hub.progress(feed.job_id)
            if progress is not None and progress != shown:
                # Only the latest: what a slow client did not get to see in between is of no use any more.
                pieces.append(format_sse_event(event="progress", data_str=progress, id=str(cursor)))
                shown = progress
            if not pieces and clock() - last_sent >= HEARTBEAT_SECONDS:
                pieces.append(KEEPALIVE_COMMENT)
            for piece in pieces:
                yield piece
                last_sent = clock()
            if more:
                continue
            if over:
                return
            with suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), max(0.0, last_sent + HEARTBEAT_SECONDS - clock()))


async def _after(hub: EventHub, feed: Feed, cursor: int) -> tuple[list[Entry], int, bool]:
    """What is new after a number, the number that is known then, and whether there is more at once."""
    if cursor >= hub.base:
        return [entry for entry in hub.since(cursor) if feed.wants(entry)], max(cursor, hub.head), False
    head = hub.head  # before the look: what comes after it is in the ring
    found = await to_thread.run_sync(feed.read, cursor, limiter=hub.readers)
    if len(found) == PAGE:
        return found, found[-1].seq, True
    return found, max(cursor, head, found[-1].seq if found else 0), False
