"""The HTTP server, with the limits of a connection that uvicorn leaves to a proxy."""

from __future__ import annotations

import asyncio
import resource
import socket

import h11
import structlog
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from l3ps_api.events.hub import EventHub
from l3ps_api.middleware import HEADER_BYTES

HEAD_BYTES = 4 * HEADER_BYTES
"""A request's head that is not complete by then is refused by the server; smaller ones get a problem document."""
_OTHER_FILES = 200  # databases, logs, the interpreter's own
_MOST_FILES = 1 << 16
_PIECE = 1 << 20

log = structlog.get_logger(__name__)


class Protocol(H11Protocol):
    """Hangs up on a client that does not get its headers out in time, or does not take what it is sent.

    Each such connection holds an open file, and what waits to be sent: a server that closes it properly waits for that.
    A client has ``SEND_SECONDS`` for a piece of 1 MiB or what is less: a download may be as slow as 18 kB/s, and one
    that is slower goes on where it was cut.

    h11, whatever else is installed: it has a limit for a head that is not complete (:data:`HEAD_BYTES`).
    """

    HEADER_SECONDS = 20.0
    SEND_SECONDS = 60.0
    _hang_up: asyncio.TimerHandle | None = None
    _give_up: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has come."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(0)  # whatever the client leaves, we are told of it
        self._expect_headers()

    def data_received(self, data: bytes) -> None:
        """Some of a request."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._expect_headers()
        else:
            self._expect_no_more()

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone."""
        self._expect_no_more()
        self._taken()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """The client has not taken all yet."""
        super().pause_writing()
        self._expect_progress()

    def resume_writing(self) -> None:
        """It has."""
        self._taken()
        super().resume_writing()

    def _expect_progress(self) -> None:
        left = self.transport.get_write_buffer_size()
        self._give_up = self.loop.call_later(self.SEND_SECONDS, self._look_at_progress, left)

    def _look_at_progress(self, before: int) -> None:
        if self.transport.get_write_buffer_size() <= before - _PIECE:
            self._expect_progress()
        else:
            log.info("hung up on a client that takes nothing")
            self.transport.abort()

    def _taken(self) -> None:
        if self._give_up is not None:
            self._give_up.cancel()
            self._give_up = None

    def _expect_headers(self) -> None:
        # Not from anew with each byte: then a byte now and then were enough.
        self._hang_up = self._hang_up or self.loop.call_later(self.HEADER_SECONDS, self.transport.abort)

    def _expect_no_more(self) -> None:
        if self._hang_up is not None:
            self._hang_up.cancel()
            self._hang_up = None


class Server(uvicorn.Server):
    """Tells streams that the process stops: they have no other end, and the server waits for all answers to end."""

    def __init__(self, config: uvicorn.Config, streams: EventHub) -> None:
        super().__init__(config)
        self._streams = streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        self._streams.close()
        await super().shutdown(sockets)


def most_connections() -> int:
    """How many connections the process can have: each may take another file, of the store's. Raises the soft limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return (wanted - _OTHER_FILES) // 2
