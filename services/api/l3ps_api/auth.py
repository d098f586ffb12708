"""Who asks, and whether they may: everything under /v1 but presigned objects passes here first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated
from urllib.parse import parse_qsl

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.types import ASGIApp, Receive, Scope, Send

from l3ps_api.keyring import Keyring, Principal
from l3ps_api.keyring import Scope as KeyScope
from l3ps_api.limits import Buckets, too_many
from l3ps_api.operations import Operation, Operations
from l3ps_api.problems import ApiProblem, ErrorItem, fault, invalid
from l3ps_api.replies import header
from l3ps_platform.errors import NotFound
from l3ps_platform.settings import Settings
from l3ps_platform.telemetry import bound

PROJECT_HEADER = "L3PS-Project"
_OPERATORS = "projects"
_ADMIN = ("keys", "webhooks", "rules", "retention", _OPERATORS)
_VERIFYING = 4
"""Credentials looked up at once: a flood of wrong ones leaves the threads and connections of everybody else alone."""
_READING = ("GET", "HEAD", "OPTIONS")
_REMEDY = "Send `Authorization: Bearer SECRET`, an API key's or the operator's (the command line reads L3PS_TOKEN)."

_bearer = HTTPBearer(auto_error=False, description="An API key's secret, or the operator's token (L3PS_TOKEN).")


async def authenticate(
    request: Request, _: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)] = None
) -> Principal:
    """The caller, whom the gate has let in."""
    found: Principal = request.state.principal
    return found


PrincipalDep = Annotated[Principal, Depends(authenticate)]


def guarded(path: str) -> bool:
    """Whether a path needs credentials. Presigned URLs carry their own; health and metrics are for machines."""
    return path.startswith("/v1/") and not path.startswith("/v1/objects/")


class Gate:
    """Lets a request under /v1 in when its credentials, their scope, its rate and its query are right.

    What gets in has a :class:`Principal` in its state, and the ids of project and key on every line it logs. Whatever
    is added under /v1 is behind this gate without a word of its own.
    """

    def __init__(
        self, app: ASGIApp, settings: Settings, keyring: Keyring, operations: Callable[[], Operations]
    ) -> None:
        self.app, self._keyring, self._operations = app, keyring, operations
        self._rates = Buckets(settings.rate_per_second, settings.rate_burst)
        self._failures = Buckets(settings.failures_per_second, settings.failures_burst)
        self._verifying, self._suspected = CapacityLimiter(_VERIFYING), CapacityLimiter(1)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not guarded(scope["path"]):
            await self.app(scope, receive, send)
            return
        needed = scope_needed(scope["method"], scope["path"])
        principal = await self._caller(scope, fresh=needed == "admin" and scope["method"] not in _READING)
        wait = self._rates.take(principal.key_id or _address(scope))
        if wait:
            raise too_many(wait, "this key asks too often" if principal.key_id else "this address asks too often")
        if not principal.may(needed):
            what = f"this needs the scope {needed}, and {principal.key_id} has {principal.scope}"
            raise _forbidden(what, f"Use a key of scope {needed}.", needed)
        if principal.key_id is not None and _collection(scope["path"]) == _OPERATORS:
            what = f"projects are the operator's, and {principal.key_id} is an API key"
            raise _forbidden(what, "Use the operator's token (L3PS_TOKEN).")
        operation = self._operations().at(scope["path"]).get(scope["method"])
        if operation is not None:
            _check_query(operation, scope["query_string"])
        scope.setdefault("state", {})["principal"] = principal
        with bound(project=principal.project_id, key=principal.key_id):
            await self.app(scope, receive, send)

    async def _caller(self, scope: Scope, *, fresh: bool) -> Principal:
        """Who asks. ``fresh``: by the catalog of now, so that no revoked key makes itself a successor elsewhere."""
        secret, project = _bearer_secret(scope), header(scope["headers"], b"l3ps-project") or ""
        found = None if fresh else self._keyring.recall(secret, project)
        if found is not None:
            return found
        # Who shares an address with a flood of wrong ones waits with them, and nobody else does.
        line = self._suspected if self._failures.wait(_address(scope)) else self._verifying
        try:
            found = await to_thread.run_sync(self._keyring.verify, secret, project, limiter=line)
        except NotFound as error:
            remedy = "GET /v1/projects lists those there are."
            raise invalid(PROJECT_HEADER, f"there is no project {error.id!r}", remedy) from error
        except PermissionError as error:
            raise _forbidden(f"the key {error} belongs to another project", f"Leave {PROJECT_HEADER} out.") from error
        if found is None:
            # Right ones never come here: nobody is locked out by what others behind the same address get wrong.
            if secret is not None and (wait := self._failures.take(_address(scope))):
                raise too_many(wait, "too many wrong credentials came from this address")
            raise _unauthorized("the bearer token is missing" if secret is None else "the credentials are not valid")
        return found


def scope_needed(method: str, path: str) -> KeyScope:
    """What a caller's scope must permit for a request."""
    if _collection(path) in _ADMIN:
        return "admin"
    return "read" if method in _READING else "write"


def _collection(path: str) -> str:
    return path.split("/")[2]


def _bearer_secret(scope: Scope) -> bytes | None:
    """What came as a bearer token; another kind of credentials is none of ours, and not right."""
    given = [value for name, value in scope["headers"] if name == b"authorization"]
    if not given:
        return None
    kind, _, secret = given[0].partition(b" ")
    return secret.strip() if len(given) == 1 and kind.lower() == b"bearer" else b""


def _address(scope: Scope) -> str:
    return scope["client"][0] if scope.get("client") else "unknown"


def _check_query(operation: Operation, query: bytes) -> None:
    seen: set[str] = set()
    errors = []
    for name, _ in parse_qsl(query.decode("latin-1"), keep_blank_values=True):
        if name not in operation.query:
            known = ", ".join(sorted(operation.query)) or "none"
            errors.append(_query_error(name, "there is no such parameter", f"Remove it; this takes: {known}."))
        elif name in seen and name not in operation.repeated:
            errors.append(_query_error(name, "it is given more than once", "Give it once."))
        seen.add(name)
    if errors:
        detail = f"{errors[0].where}: {errors[0].what}. {errors[0].remedy}"
        raise ApiProblem(422, "invalid-request", "The request cannot be used", detail, errors)


def _query_error(name: str, what: str, remedy: str) -> ErrorItem:
    return ErrorItem(where=f"query {name[:100]}", what=what, remedy=remedy)


def _unauthorized(what: str) -> ApiProblem:
    challenge = {"WWW-Authenticate": "Bearer"}
    return fault(401, "unauthorized", "Unauthorized", "Authorization", what, _REMEDY, challenge)


def _forbidden(what: str, remedy: str, scope: str | None = None) -> ApiProblem:
    challenge = {"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{scope}"'} if scope else {}
    return fault(403, "forbidden", "Forbidden", "Authorization", what, remedy, challenge)
