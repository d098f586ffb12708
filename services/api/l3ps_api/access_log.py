"""One line a request, and an id that all lines of a request share and its client can name."""

from __future__ import annotations

import re
import secrets
import time
from typing import Any

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from l3ps_platform.telemetry import bound

log = structlog.get_logger(__name__)

HEADER = b"x-request-id"
_GIVEN = re.compile(rb"[A-Za-z0-9._:-]{1,64}")
_UNWATCHED = ("/healthz", "/readyz", "/metrics")
"""Asked every few seconds by machines: their lines would drown the others."""


class AccessLog:
    """Logs every request once it is answered, with its client's id for it (``X-Request-Id``) or one made here.

    Paths are logged as templates with the ids in them, never as they came: a presigned URL is as good as a key.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = _request_id(scope)
        started, status, sent, received = time.perf_counter(), 500, 0, 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        async def observed(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": [*message.get("headers", ()), (HEADER, request_id.encode())]}
            sent += len(message.get("body", b""))
            await send(message)

        with bound(request=request_id):
            try:
                await self.app(scope, counted, observed)
            finally:
                _write(scope, status, time.perf_counter() - started, sent, received)


def _write(scope: Scope, status: int, seconds: float, sent: int, received: int) -> None:
    said: dict[str, Any] = {
        "method": scope["method"],
        "route": getattr(scope.get("route"), "path", "unknown"),
        "status": status,
        "seconds": round(seconds, 4),
        "bytes": sent,
    }
    if received:
        said["bytes_in"] = received
    principal = scope.get("state", {}).get("principal")
    if principal is not None:
        said |= {"project": principal.project_id, "key": principal.key_id or "operator"}
    for name, value in scope.get("path_params", {}).items():
        if name.endswith("_id"):
            said[name.removesuffix("_id")] = str(value)[:64]
    tell = log.debug if scope["path"] in _UNWATCHED else log.info
    tell("answered", **said)


def _request_id(scope: Scope) -> str:
    """The client's id for the request where it has a harmless one, else a new one."""
    given: bytes = next((value for name, value in scope["headers"] if name == HEADER), b"")
    return given.decode() if _GIVEN.fullmatch(given) else f"req_{secrets.token_hex(8)}"
