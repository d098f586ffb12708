"""Idempotency-Key: a POST that is sent twice happens once and is answered alike."""

from __future__ import annotations

import hashlib
import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import structlog
from anyio import CapacityLimiter, to_thread
from pydantic import BaseModel
from starlette.types import ASGIApp, Receive, Scope, Send

from l3ps_api.keyring import SECRET, Principal
from l3ps_api.limits import over_quota
from l3ps_api.operations import Operations
from l3ps_api.problems import ApiProblem, fault
from l3ps_api.replies import Reply, again, ask, hold, read_body
from l3ps_api.services import Services
from l3ps_platform.catalog import requests
from l3ps_platform.errors import CatalogUnavailable

log = structlog.get_logger(__name__)

KEEP_BYTES = 16 << 10
"""An answer larger than this is not kept but made again, from its resource where it has one."""
MOST_KEYS = 100_000
"""Of a project at a time: with what is kept of each, 1.6 GB. More than one new key a second, all day."""

_COLLECTIONS = {"api_keys": "keys"}
"""Where a table's rows are found under /v1, if not under its own name."""
_TRANSIENT = (b"content-length", b"date", b"server", b"connection", b"transfer-encoding", b"set-cookie")
_KEY = re.compile(r"[\x20-\x7e]{1,255}")
_QUOTED_SECRET = re.compile(rb'"' + SECRET.pattern + rb'"')
_PURGE_SECONDS = 60.0
_AT_ONCE = 4
"""Looks at keys, in threads of their own: they take no turn, and are not to have the threads of those who do."""
_NOT_KEPT = (401, 403, 429)
_SHOWN_ONCE = {"api_keys"}
"""Tables whose secret a repetition does not show again: the catalog does not have it."""

Remade = Mapping[str, Callable[[Services, str], BaseModel]]
"""By table: makes the answer to the POST from the resource it made, where GET answers something else."""


class Idempotency:
    """Answers a repeated POST under /v1 as the first was answered, without doing it again.

    In one place for all routes: the effect is tied to the key by :mod:`l3ps_platform.catalog.requests`, in the commit
    that makes it. Answers of the kind "try again" (429, 5xx) are not kept, nor what lets nobody in (401, 403). Secrets
    and signed URLs are never kept: they are left out, or made again from their resource.
    """

    def __init__(self, app: ASGIApp, services: Services, operations: Callable[[], Operations], remade: Remade) -> None:
        self.app, self._services, self._operations, self._remade = app, services, operations, remade
        self._purged_at = time.monotonic()
        self._threads = CapacityLimiter(_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        principal: Principal | None = scope.get("state", {}).get("principal") if scope["type"] == "http" else None
        given = [value for name, value in scope.get("headers", ()) if name == b"idempotency-key"]
        if principal is None or scope["method"] != "POST" or not given:
            await self.app(scope, receive, send)
            return
        key = _usable(given)
        body = await read_body(receive)
        if body is None:
            return  # the client has gone in the middle of its request
        services = replace(self._services, catalog=self._services.catalog.scoped(principal.project_id))
        try:
            asked = fingerprint(principal, scope, body)
            state = await to_thread.run_sync(self._begin, services, key, asked, limiter=self._threads)
        except requests.OtherRequest:
            what = "it was used for another request, or by another caller"
            raise _refused(422, "idempotency-key-reused", what, "Use a new key.") from None
        except requests.TooMany:
            remedy = "Each is kept for a day (L3PS_IDEMPOTENCY_SECONDS): send the same key with what is repeated alone."
            raise over_quota("Idempotency-Key", MOST_KEYS, "keys", remedy) from None
        if isinstance(state, requests.Busy):
            after = max(1, math.ceil(min(state.seconds, 2)))
            what, remedy = "the first request with it is still in progress", f"Ask again in {after} s."
            raise _refused(409, "request-in-progress", what, remedy, {"Retry-After": str(after)})
        if isinstance(state, requests.Kept):
            reply = await self._kept(scope, services, state)
        else:
            reply = await self._done(scope, services, state, body, receive, send)
        await reply.send(send)

    def _begin(self, services: Services, key: str, asked: str) -> requests.Held | requests.Kept | requests.Busy:
        settings = services.settings
        seconds = {
            "lease_seconds": settings.idempotency_lease_seconds, "keep_seconds": settings.idempotency_seconds
        }  # fmt: skip
        if time.monotonic() - self._purged_at > _PURGE_SECONDS:
            self._purged_at = time.monotonic()
            with self._services.catalog.transaction() as tx:
                requests.purge(tx)
        with services.catalog.transaction() as tx:
            return requests.begin(tx, key, asked, **seconds, most=MOST_KEYS)

    async def _kept(self, scope: Scope, services: Services, kept: requests.Kept) -> Reply:
        headers = [(name.encode("latin-1"), value.encode("latin-1")) for name, value in kept.headers.items()]
        body = kept.body
        if body is None and kept.made is not None:
            remade = await self._remake(scope, services, kept.made)
            if remade.status != 200:
                return remade
            body = remade.body
        return Reply(kept.status, [*headers, (b"idempotent-replay", b"true")], body or b"")

    async def _done(
        self, scope: Scope, services: Services, held: requests.Held, body: bytes, receive: Receive, send: Send
    ) -> Reply:
        """Do what is asked; or, where a try that was cut off has done it, answer for it."""
        if held.made is not None:
            reply = await self._remake(scope, services, held.made)
            if reply.status == 200:
                operation = self._operations().at(scope["path"]).get("POST")
                reply.status = operation.status if operation is not None else 200
                reply.headers = [(name, value) for name, value in reply.headers if name == b"content-type"]
                reply.headers.append((b"location", _place(held.made).encode()))
        else:
            known = self._operations()
            operation = known.at(scope["path"]).get("POST")
            # What it makes can answer for it only where the answer is a resource; a notification's is a count.
            kinds = known.kinds if operation is not None and operation.resource else frozenset[str]()
            tables = {folder: folder for folder in kinds} | {
                folder: table for table, folder in _COLLECTIONS.items() if folder in kinds
            }
            only = tables.get(scope["path"].removeprefix("/v1/"))
            with requests.bound(replace(held, kinds=frozenset(tables.values()), only=only)):
                reply = await hold(self.app, scope, again(body, receive), send) or Reply()
        await to_thread.run_sync(self._record, services, held, reply, limiter=self._threads)
        return reply

    def _record(self, services: Services, held: requests.Held, reply: Reply) -> None:
        try:
            with services.catalog.transaction() as tx:
                if reply.status >= 500 or reply.status in _NOT_KEPT:
                    requests.release(tx, held)
                    return
                headers = {
                    name.decode("latin-1"): value.decode("latin-1")
                    for name, value in reply.headers if name not in _TRANSIENT
                }  # fmt: skip
                body = _QUOTED_SECRET.sub(b"null", reply.body)  # shown once, and never kept
                private = "no-store" in (reply.header(b"cache-control") or "")
                tables = frozenset(self._remade) - _SHOWN_ONCE
                requests.finish(
                    tx, held, reply.status, headers, body, limit=KEEP_BYTES, private=private, again=tables
                )  # fmt: skip
        except CatalogUnavailable as error:
            log.warning("an answer could not be kept; its lease runs out", reason=str(error))

    async def _remake(self, scope: Scope, services: Services, made: requests.Made) -> Reply:
        """The answer for a resource that an earlier request made."""
        kind, id = made
        if kind in self._remade:
            document = await to_thread.run_sync(self._remade[kind], services, id, limiter=self._threads)
            return Reply(200, [(b"content-type", b"application/json")], document.model_dump_json().encode())
        return await ask(self.app, scope, _place(made))


def _place(made: requests.Made) -> str:
    kind, id = made
    return f"/v1/{_COLLECTIONS.get(kind, kind)}/{id}"


def _usable(given: list[bytes]) -> str:
    key = given[0].decode("latin-1")
    if len(given) > 1 or not _KEY.fullmatch(key):
        what = "it must come once and have 1 to 255 printable ASCII characters"
        raise _refused(422, "invalid-request", what, "A fresh UUID for every new request does well.")
    return key


def fingerprint(principal: Principal, scope: Scope, body: bytes) -> str:
    """SHA-256 of who asks and what for: path, query and body."""
    found = hashlib.sha256(f"{principal.key_id or 'the operator'}\n".encode())
    found.update(scope.get("raw_path", scope["path"].encode()) + b"?" + scope["query_string"] + b"\n")
    found.update(body)
    return found.hexdigest()


def _refused(
    status: int, code: str, what: str, remedy: str, headers: Mapping[str, str] | None = None
) -> ApiProblem:  # fmt: skip
    return fault(status, code, "The key cannot be used now", "Idempotency-Key", what, remedy, headers)
