"""What every request passes before it reaches a route: measurement, a guard of the host name, a limit of size."""

from __future__ import annotations

import asyncio
import time

from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from l3ps_api.problems import answer, fault, too_large

JSON_BODY_BYTES = 2 << 20
"""The largest JSON body taken: the completion of an upload of 10,000 parts is below 1 MB."""

BODY_SECONDS = 60.0
"""A client has so long to send a JSON body."""

HEADER_BYTES = 16 << 10
"""All headers of a request."""

_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
_LOOPBACK = {"127.0.0.1", "localhost", "[::1]"}


class RequestMetrics:
    """Counts and times requests by method, route template and status."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self.app = app
        labels = ("method", "route")
        self.requests = Counter("l3ps_http_requests", "Requests answered.", (*labels, "status"), registry=registry)
        self.seconds = Histogram("l3ps_http_request_seconds", "Time to answer.", labels, registry=registry)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        start, status = time.perf_counter(), 500

        async def observed(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self.app(scope, receive, observed)
        finally:
            # Templates, not paths: a path holds ids, and every id would be a time series of its own.
            route = getattr(scope.get("route"), "path", "unknown")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self.requests.labels(method, route, status).inc()
            self.seconds.labels(method, route).observe(time.perf_counter() - start)


class LoopbackHosts:
    """On a loopback address, answers only to loopback names.

    Without it any web page could reach a tokenless local service by making its own name resolve to 127.0.0.1.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            host = next((value.decode("latin-1") for name, value in scope["headers"] if name == b"host"), "")
            name = host if host.endswith("]") else host.rpartition(":")[0] or host
            if name.lower() not in _LOOPBACK:
                what = f"this service listens on the loopback interface and does not answer to the name {name!r}"
                remedy = "Use 127.0.0.1 or localhost, or start it with L3PS_HOST set to the address it is to serve."
                problem = fault(421, "foreign-host", "Wrong host name", "Host", what, remedy)
                await answer(problem, scope["path"])(scope, receive, send)
                return
        await self.app(scope, receive, send)


class SizeLimits:
    """Refuses headers and JSON bodies that are too large, the latter before they are read where they tell their length.

    Nor does it wait for ever for a body whose client sends no more of it.

    ``exempt`` is the begin of paths whose bodies may be of any size.
    """

    def __init__(self, app: ASGIApp, exempt: str) -> None:
        self.app, self.exempt = app, exempt

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        if size > HEADER_BYTES:
            what = f"the headers have {size} bytes, and {HEADER_BYTES} at most are read"
            problem = fault(
                431, "headers-too-large", "Headers too large", "headers", what, "Send fewer or shorter ones."
            )
            await answer(problem, scope["path"])(scope, receive, send)
            return
        if scope["path"].startswith(self.exempt):
            await self.app(scope, receive, send)
            return
        what = f"the body is larger than {JSON_BODY_BYTES} bytes"
        remedy = "Drive logs and models go to the part URLs that POST /v1/uploads hands out."
        declared = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
        if declared.isdigit() and int(declared) > JSON_BODY_BYTES:
            await answer(too_large("body", what, remedy), scope["path"])(scope, receive, send)
            return
        received, whole, deadline = 0, False, asyncio.get_running_loop().time() + BODY_SECONDS

        async def limited() -> Message:
            nonlocal received, whole
            try:
                async with asyncio.timeout_at(None if whole else deadline):
                    message = await receive()
            except TimeoutError:
                slow = f"the body did not come within {BODY_SECONDS:.0f} s. Send it at once"
                raise HTTPException(408, slow, {"Connection": "close"}) from None
            received += len(message.get("body", b""))
            whole = not message.get("more_body", False)
            if received > JSON_BODY_BYTES:
                raise HTTPException(413, f"{what}. {remedy}")  # FastAPI lets no other exception through here
            return message

        await self.app(scope, limited, send)
