"""Reading an S3 object whatever the connection does: a stream that ends is complete, one that breaks off goes on."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import structlog
import urllib3
from urllib3.response import BaseHTTPResponse

from l3ps_platform.errors import StoreUnavailable

log = structlog.get_logger(__name__)

_RESUMES = 4
"""How often a stream goes on without having received anything in between."""

Fetch = Callable[[int, str | None], BaseHTTPResponse]
"""The answer to a GET from an offset on; of the object with this etag only, where one is given."""


class S3Stream(io.RawIOBase):
    """An object from an offset to its end.

    The answer's Content-Length is what has to come; a connection that ends before, or fails, is made again with a
    ``Range`` from there on, a few times, for the same etag: what was read never mixes two objects.

    Args:
        what: the object, for messages.
        fetch: makes a request.
        offset: where to begin, bytes.
    """

    def __init__(self, what: str, fetch: Fetch, offset: int = 0) -> None:
        self._what, self._fetch = what, fetch
        self._response: BaseHTTPResponse | None = None
        self._position = self._end = offset
        self._fruitless = 0
        first = self._response = self._request(None)
        self._etag = first.headers.get("etag")
        self._end = offset + int(first.headers["content-length"])

    def readable(self) -> bool:
        """It is."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """The next bytes; 0 at the end and nowhere else. StoreUnavailable."""
        wanted = min(len(buffer), self._end - self._position)
        while wanted:
            try:
                block = self._response.read(wanted) if self._response is not None else b""
            except urllib3.exceptions.HTTPError as error:
                self._resume(error)
                continue
            if not block:
                self._resume(None)
                continue
            buffer[: len(block)] = block
            self._position += len(block)
            self._fruitless = 0
            return len(block)
        return 0

    def close(self) -> None:
        """Give the connection back, or close it where something is left in it."""
        if not self.closed:
            self._let_go()
        super().close()

    def _resume(self, error: Exception | None) -> None:
        self._let_go()
        self._fruitless += 1
        reason = error or f"{self._end - self._position} bytes are missing"
        if self._fruitless > _RESUMES or self._etag is None:
            raise StoreUnavailable(f"the object store broke off while it sent {self._what}: {reason}") from error
        log.warning("stream broke off, going on", object=self._what, at=self._position, reason=str(reason))
        time.sleep(0.1 * 2**self._fruitless)
        self._response = self._request(self._etag)

    def _request(self, etag: str | None) -> BaseHTTPResponse:
        answer = self._fetch(self._position, etag)
        if "content-length" in answer.headers and (answer.status == 206 or self._position == 0):
            return answer
        answer.close()
        raise StoreUnavailable(f"the object store does not send {self._what} as asked: no length, or no range")

    def _let_go(self) -> None:
        response, self._response = self._response, None
        if response is not None:
            if self._position < self._end:  # a connection with something left in it is of no use to anybody
                response.close()
            response.release_conn()
