"""ETags of JSON documents: 304 for what the client has, 412 before a change to what it has not seen."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial

from anyio import from_thread
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from l3ps_api.auth import guarded
from l3ps_api.operations import Operations
from l3ps_api.places import Turns
from l3ps_api.problems import fault, unavailable
from l3ps_api.replies import Reply, again, ask, header, hold, read_body
from l3ps_platform.catalog.conditions import only_if

_CHANGING = ("PUT", "PATCH", "DELETE")
_AT_ONCE = 8
"""Changes with a condition: each takes a thread and a connection, and asks with others of them."""
_WAITING, _WAITING_BYTES = 100, 16 << 20
"""Such changes of a project that wait, each with its body."""


class ETags:
    """Gives every JSON answer to a GET under /v1 a strong ETag, and honours If-None-Match and If-Match.

    A route that knows a cheaper or steadier tag sets it itself; it is left as it is.

    A change asks what it changes in the middle of its transaction, while others wait for that transaction: for SQLite's
    one lock, for a row of PostgreSQL. These may have all turns of the project and all connections of the catalog, and
    would never give them back, so the question takes neither: no turn, and a connection of a pool of its own
    (``app.state.beside``), which has 15 for the 8 that ask at once. It reads, and no reader waits for a lock. It takes
    one of the 40 threads: those who may wait for the catalog in them have 32 turns, and what needs none has threads of
    its own (idempotency, event streams, credentials) but for the hub, the metrics and the readiness, one each. So five
    are left whoever waits; what else has them waits for the disk or the store, and ends by itself.
    """

    def __init__(self, app: ASGIApp, operations: Callable[[], Operations]) -> None:
        self.app, self._operations = app, operations
        self._few = Turns(_AT_ONCE, _WAITING, _WAITING_BYTES)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not guarded(scope["path"]):
            await self.app(scope, receive, send)
        elif scope["method"] == "GET":
            await self._get(scope, receive, send)
        elif (wanted := header(scope["headers"], b"if-match")) is not None and self._has_document(scope):
            await self._change(scope, receive, send, wanted)
        else:
            await self.app(scope, receive, send)

    def _has_document(self, scope: Scope) -> bool:
        """Whether this changes a document that GET answers; streams and archives have no end to wait for."""
        if scope["method"] not in _CHANGING:
            return False
        here = self._operations().at(scope["path"])
        return scope["method"] in here and "GET" in here and here["GET"].document

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
        async with self._few.turn(scope["state"]["principal"].project_id, len(body)):
            reply = await self._check(scope, wanted)
            if reply is None:
                with only_if(lambda: self._check_again(scope, wanted)):
                    reply = await hold(self.app, scope, again(body, receive), send) or Reply()
        await reply.send(send)  # takes as long as the client does

    def _check_again(self, scope: Scope, wanted: str) -> None:
        if from_thread.run(partial(self._check, scope, wanted, within=True)) is not None:
            raise unavailable("document")

    async def _check(self, scope: Scope, wanted: str, *, within: bool = False) -> Reply | None:
        """Refuse a change to another document than the client has seen; the answer of a service that cannot tell."""
        present = await ask(self.app, scope, scope["path"], within=within)
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
