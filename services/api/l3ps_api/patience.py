"""Answers that last: whoever does not take them is hung up on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import structlog
from starlette.responses import StreamingResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

log = structlog.get_logger(__name__)

SEND_SECONDS = 60.0
"""A client that does not take a piece for so long, its buffers and ours full, is hung up on. Pieces have at most 1 MiB:
a download may be as slow as 18 kB/s, and one that is slower goes on where it was cut."""

_EXTENSION = "l3ps.hang_up"


class PatientResponse(StreamingResponse):
    """A streamed answer that ends when the client does not take it."""

    _hang_up: Callable[[], None] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._hang_up = scope.get("extensions", {}).get(_EXTENSION)
        await super().__call__(scope, receive, send)

    async def stream_response(self, send: Send) -> None:
        """Send all there is, each piece within ``SEND_SECONDS``."""

        async def patiently(message: Message) -> None:
            async with asyncio.timeout(SEND_SECONDS):
                await send(message)

        try:
            await super().stream_response(patiently)
        except TimeoutError:
            log.info("hung up on a client that takes nothing")
            if self._hang_up is not None:
                self._hang_up()
                await asyncio.sleep(0)  # lets the server see it, which else calls it an error that we end early


class HangUp:
    """Lets answers break their connection; to be the first that sees a request.

    ASGI has no word for it: a server closes a connection properly, when all that waits is sent, and to a client that
    reads nothing it never is. Its socket and what waits would stay for ever.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # Of uvicorn this is a method of what holds the connection.
        transport = getattr(getattr(send, "__self__", None), "transport", None)
        if isinstance(transport, asyncio.WriteTransport):
            scope.setdefault("extensions", {})[_EXTENSION] = transport.abort
        await self.app(scope, receive, send)
