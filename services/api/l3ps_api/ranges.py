"""Downloads that can be resumed at any byte: one range of a body whose length is known beforehand (RFC 9110, 14)."""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator, Callable, Generator, Iterator, Mapping
from contextlib import aclosing

import structlog
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from l3ps.errors import L3psError
from l3ps_api.problems import ApiProblem, ErrorItem, answer

log = structlog.get_logger(__name__)

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.IGNORECASE)

Read = Callable[[int, int], Iterator[bytes]]
"""Yields the bytes from a first up to, and without, a last position; what lies before is not read."""


class RangedResponse(StreamingResponse):
    """A body of known length, whole or the one range that was asked for.

    Blocks come from a thread, one at a time and only as fast as the client takes them, so memory stays flat whatever
    the length. A source that fails cuts the connection: the client has the Content-Length and sees that it lacks bytes.

    Args:
        read: the body.
        size: its length, bytes.
        etag: strong: two bodies of one etag are the same to the byte; without quotes.
        media_type: Content-Type.
        headers: further headers.
        close: called when the answer has ended, whatever it came to.
    """

    def __init__(
        self,
        read: Read,
        size: int,
        etag: str,
        media_type: str,
        headers: Mapping[str, str],
        close: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(iter(()), media_type=media_type, headers={"Accept-Ranges": "bytes", **headers})
        self._read, self._size, self._close = read, size, close
        self.headers["ETag"] = self._etag = f'"{etag}"'

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._answer(scope, receive, send)
        finally:
            self._close()

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked = Headers(scope=scope)
        if not {self._etag, "*"} & _tags(asked.get("if-match", "*")):
            await answer(_changed(self._etag), scope["path"])(scope, receive, send)
            return
        if {self._etag, "*"} & _tags(asked.get("if-none-match", "").replace("W/", "")):
            self.status_code = 304
            await super().__call__(scope, receive, send)
            return
        begin, end = 0, self._size
        wanted = asked.get("range")
        if wanted is not None and asked.get("if-range", self._etag) == self._etag:
            found = byte_range(wanted, self._size)
            if found is not None and found[0] >= found[1]:
                await answer(_unsatisfiable(wanted, self._size), scope["path"])(scope, receive, send)
                return
            if found is not None:
                begin, end = found
                self.status_code = 206
                self.headers["Content-Range"] = f"bytes {begin}-{end - 1}/{self._size}"
        self.headers["Content-Length"] = str(end - begin)
        async with aclosing(_threaded(self._read(begin, end) if scope["method"] != "HEAD" else iter(()))) as blocks:
            self.body_iterator = blocks
            await super().__call__(scope, receive, send)


def byte_range(header: str, size: int) -> tuple[int, int] | None:
    """First position and the one after the last; empty when nothing of the body is in it; None for what is to be
    ignored: another unit, several ranges, no range at all."""
    found = _RANGE.fullmatch(header.strip())
    if found is None or not (found[1] or found[2]) or (found[1] and found[2] and int(found[2]) < int(found[1])):
        return None
    if not found[1]:
        return max(0, size - int(found[2])), size
    return int(found[1]), min(size, int(found[2]) + 1) if found[2] else size


def _tags(header: str) -> set[str]:
    return {tag.strip() for tag in header.split(",")}


def _changed(etag: str) -> ApiProblem:
    what = f"the ETag is {etag} now"
    error = ErrorItem(where="If-Match", what=what, remedy="Download it again from the beginning.")
    detail = f"What you began to download is another one now: {what}. {error.remedy}"
    return ApiProblem(412, "changed", "It has changed", detail, [error])


def _unsatisfiable(wanted: str, size: int) -> ApiProblem:
    what = f"{wanted!r} lies beyond the {size} bytes that there are"
    remedy = "Ask for a range that begins before the end; HEAD tells the length."
    error = ErrorItem(where="Range", what=what, remedy=remedy)
    headers = {"Content-Range": f"bytes */{size}"}
    return ApiProblem(
        416, "range-not-satisfiable", "No such range", f"Range: {what}. {remedy}", [error], headers=headers
    )


async def _threaded(blocks: Iterator[bytes]) -> AsyncGenerator[bytes]:
    try:
        while (block := await run_in_threadpool(next, blocks, None)) is not None:
            yield block
    except L3psError as error:
        log.warning("download cut", reason=str(error))
        raise
    finally:
        if isinstance(blocks, Generator):
            blocks.close()  # and with it what it reads from
