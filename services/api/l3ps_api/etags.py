"""ETags of JSON documents: 304 for what the client has, 412 before a change to what it has not seen."""

from __future__ import annotations

import asyncio
import hashlib

from anyio import from_thread
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from l3ps_api.auth import guarded
from l3ps_api.problems import fault, unavailable
from l3ps_api.replies import Reply, again, ask, header, hold, read_body
from l3ps_platform.catalog.conditions import only_if

_CHANGING = ("PUT", "PATCH", "DELETE")
_AT_ONCE = 8
"""Changes with a condition: each takes a thread and a connection, and asks with others of them (there are 40, 15)."""


class ETags:
    """Gives every JSON answer to a GET under /v1 a strong ETag, and honours If-None-Match and If-Match.

    A route that knows a cheaper or steadier tag sets it itself; it is left as it is.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._few = asyncio.Semaphore(_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not guarded(scope["path"]):
            await self.app(scope, receive, send)
        elif scope["method"] == "GET":
            await self._get(scope, receive, send)
        elif scope["method"] in _CHANGING and (wanted := header(scope["headers"], b"if-match")) is not None:
            await self._change(scope, receive, send, wanted)
        else:
            await self.app(scope, receive, send)

    async def _get(self, scope: Scope, receive: Receive, send: Send) -> None:
        reply = await hold(self.app, scope, receive, send, _is_document)
        if reply is None:
            return
        _tag(reply)
        if _names(header(scope["headers"], b"if-none-match"), reply.header(b"etag"), weak=True):
            kept = (b"etag", b"cache-control", b"vary", b"location")
            reply = Reply(304, [(name, value) for name, value in reply.headers if name in kept])
        await reply.send(send)

    async def _change(self, scope: Scope, receive: Receive, send: Send, wanted: str) -> None:
        body = await read_body(receive)  # first: nobody waits for a client that takes its time
        if body is None:
            return
        async with self._few:
            refusal = await self._check(scope, wanted)
            if refusal is not None:
                await refusal.send(send)
                return
            with only_if(lambda: self._check_again(scope, wanted)):
                await self.app(scope, again(body, receive), send)

    def _check_again(self, scope: Scope, wanted: str) -> None:
        if from_thread.run(self._check, scope, wanted) is not None:
            raise unavailable("document")

    async def _check(self, scope: Scope, wanted: str) -> Reply | None:
        """Refuse a change to another document than the client has seen; the answer of a service that cannot tell."""
        present = await ask(self.app, scope, scope["path"])
        if present.status >= 500:
            return present
        if present.status != 200:
            return None  # the change itself says that there is nothing, or nothing to read
        _tag(present)
        if not _names(wanted, present.header(b"etag"), weak=False):
            remedy = "GET it again, look at what changed, and send its new ETag."
            what = f"the document is not the one with the ETag {wanted[:100]}"
            raise fault(412, "changed", "The document has changed", "If-Match", what, remedy)
        return None


def _is_document(start: Message) -> bool:
    kind = header(list(start["headers"]), b"content-type") or ""
    return start["status"] == 200 and kind.partition(";")[0] == "application/json"


def _tag(reply: Reply) -> None:
    if reply.header(b"etag") is None:
        reply.headers.append((b"etag", f'"{hashlib.blake2b(reply.body, digest_size=16).hexdigest()}"'.encode()))
    if reply.header(b"cache-control") is None:
        reply.headers.append((b"cache-control", b"private, no-cache"))


def _names(given: str | None, etag: str | None, *, weak: bool) -> bool:
    """Whether a list of ETags contains one; a weak one counts for reading alone (RFC 9110, 13.1)."""
    if given is None or etag is None:
        return False
    if given.strip() == "*":
        return True
    tags = [tag.strip() for tag in given.split(",")]
    if weak:
        tags, etag = [tag.removeprefix("W/") for tag in tags], etag.removeprefix("W/")
    return etag in tags and (weak or not etag.startswith("W/"))
