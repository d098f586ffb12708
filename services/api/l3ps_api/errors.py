"""From exceptions to problem documents: the only place that catches what routes and services raise."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Any

import sqlalchemy.exc
import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from l3ps.errors import InputError
from l3ps_api.operations import operations_of
from l3ps_api.problems import ApiProblem, ErrorItem, answer, fault, invalid, items, too_large, unavailable, unknown
from l3ps_platform.errors import (
    CatalogUnavailable,
    Conflict,
    InvalidKey,
    InvalidSignature,
    NotFound,
    ObjectMissing,
    QueueUnavailable,
    StoreUnavailable,
    UploadError,
)

log = structlog.get_logger(__name__)
Handler = Callable[[Request, Any], Awaitable[JSONResponse]]
_NEW_URL = "Ask the API for a new URL."


def install(app: FastAPI) -> None:
    """Register the handlers; to be called before other middleware is added, which then sees these answers."""
    app.add_middleware(Problems)
    for kind, translate in _TRANSLATIONS:
        app.add_exception_handler(kind, _handler(translate))


class Problems:
    """Answers with a problem document to what nothing further in has caught; logs what nobody expected.

    Innermost it stands in for a handler of ``Exception``: after that one's answer Starlette raises the exception again,
    upon which the server closes the connection under a client that may already be sending its next request. Around
    other middleware it turns into answers what that raises.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        started = False

        async def observed(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self.app(scope, receive, observed)
        except Exception as error:
            if started or scope["type"] != "http":
                raise
            problem = _problem(Request(scope), error)
            await answer(problem, scope["path"])(scope, receive, send)


def _problem(request: Request, error: Exception) -> ApiProblem:
    for kind, translate in _TRANSLATIONS:
        if isinstance(error, kind):
            return translate(request, error)
    log.error("request failed", method=request.method, path=request.url.path, exc_info=error)
    what, remedy = "the fault is in the service, not in the request", "Its log says more."
    return fault(500, "internal", "Internal error", "service", what, remedy)


def _handler(translate: Callable[[Request, Any], ApiProblem]) -> Handler:
    async def handle(request: Request, error: Exception) -> JSONResponse:
        return answer(translate(request, error), request.url.path)

    return handle


def _as_is(_: Request, problem: ApiProblem) -> ApiProblem:
    return problem


def _invalid_request(_: Request, error: RequestValidationError) -> ApiProblem:
    errors = [_field_error(fault) for fault in error.errors()]
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    first = errors[0]
    detail = f"{first.where}: {first.what}. {first.remedy}{more}"
    return ApiProblem(422, "invalid-request", "The request cannot be used", detail, errors)


def _field_error(fault: dict[str, Any]) -> ErrorItem:
    place, *names = [str(part) for part in fault["loc"]]
    kind = fault["type"]
    if kind == "json_invalid":
        return ErrorItem(where="body", what="the body is not valid JSON", remedy="Send a JSON object.")
    if place == "body" and not names and kind != "missing":
        remedy = "Send one, with `Content-Type: application/json`."
        return ErrorItem(where="body", what="the body is not a JSON object", remedy=remedy)
    name = ".".join(names)
    where = name if place == "body" and name else f"{place} {name}".rstrip()
    what = str(fault["msg"]).removeprefix("Value error, ")
    what = what[:1].lower() + what[1:]
    if kind == "missing":
        return ErrorItem(where=where, what="the field is missing", remedy="Add it.")
    if kind == "extra_forbidden":
        return ErrorItem(where=where, what="there is no such field", remedy="Remove it or correct its name.")
    if kind == "malformed_cursor":
        return ErrorItem(where=where, what=what, remedy="Send `next` of the page before.")
    if kind == "far_off_date":
        return ErrorItem(where=where, what=what, remedy="Name a nearer one, as 2026-01-31T12:00:00Z.")
    return ErrorItem(where=where, what=what, remedy="/openapi.json says what this field takes.")


def _http_error(request: Request, error: HTTPException) -> ApiProblem:
    status = HTTPStatus(error.status_code)
    path = request.url.path
    code = status.phrase.lower().replace(" ", "-")
    headers = dict(error.headers or {})
    if status == HTTPStatus.NOT_FOUND:
        what, remedy = f"there is nothing at {path}", "Use a path of /openapi.json."
        return fault(status, code, status.phrase, "path", what, remedy, headers)
    if status == HTTPStatus.METHOD_NOT_ALLOWED:
        # Starlette names the methods of the first route that has the path; there may be several.
        methods = sorted(operations_of(request.app).at(path)) or headers.get("Allow", "GET").split(", ")
        headers["Allow"] = allowed = ", ".join(methods)
        what, remedy = f"{request.method} does not work on {path}", f"It takes {allowed}."
        return fault(status, code, status.phrase, "method", what, remedy, headers)
    if status == HTTPStatus.BAD_REQUEST:  # FastAPI's word for a body that is no UTF-8
        return invalid("body", "the body is not valid JSON", "Send a JSON object.")
    if status == HTTPStatus.REQUEST_ENTITY_TOO_LARGE:
        what, _, remedy = str(error.detail).partition(". ")
        return too_large("body", what, remedy)
    if status == HTTPStatus.REQUEST_TIMEOUT:
        what, _, remedy = str(error.detail).partition(". ")
        return fault(status, code, status.phrase, "body", what, remedy, headers)
    return ApiProblem(status, code, status.phrase, str(error.detail), headers=headers)


def _bad_input(_: Request, error: InputError) -> ApiProblem:
    return ApiProblem(422, "bad-input", "The input cannot be used", str(error), items(error.problems))


def _not_found(request: Request, error: NotFound) -> ApiProblem:
    in_path = error.id in request.path_params.values()
    return unknown(error.kind, error.id, "path" if in_path else {"drive": "drive_id"}.get(error.kind, error.kind))


def _conflict(_: Request, error: Conflict) -> ApiProblem:
    what, remedy = _parted(error, "GET it to see why.")
    return fault(409, "conflict", "Not possible in the present state", "state", what, remedy)


def _forbidden(_: Request, error: InvalidSignature | InvalidKey) -> ApiProblem:
    return fault(403, "invalid-signature", "The URL does not permit this", "url", *_parted(error, _NEW_URL))


def _no_object(_: Request, error: ObjectMissing) -> ApiProblem:
    return fault(404, "unknown-object", "Unknown object", "url", *_parted(error, _NEW_URL))


def _upload_error(_: Request, error: UploadError) -> ApiProblem:
    return fault(409, "upload-closed", "The upload is closed", "upload", *_parted(error, "Begin a new one."))


def _down(what: str) -> Callable[[Request, Exception], ApiProblem]:
    def translate(_: Request, error: Exception) -> ApiProblem:
        log.warning(f"{what} unavailable", reason=str(error))
        return unavailable(what)

    return translate


def _parted(error: Exception, remedy: str) -> tuple[str, str]:
    """What is wrong and what to do: the platform's messages have a colon between them."""
    what, _, given = str(error).partition(": ")
    return what, f"{given[:1].upper()}{given[1:].rstrip('.')}." if given else remedy


def _unkept(_: Request, error: sqlalchemy.exc.DataError) -> ApiProblem:
    # An id or cursor with a NUL, for one: PostgreSQL refuses to look for it where SQLite finds nothing.
    log.info("refused by the database", reason=str(error.orig))
    what = "it holds a character or a number that no row can hold"
    return invalid("request", what, "Look at its path and query for NUL characters and numbers beyond 64 bits.")


_TRANSLATIONS: tuple[tuple[type[Exception], Callable[[Request, Any], ApiProblem]], ...] = (
    (ApiProblem, _as_is),
    (RequestValidationError, _invalid_request),
    (HTTPException, _http_error),
    (InputError, _bad_input),
    (NotFound, _not_found),
    (Conflict, _conflict),
    (InvalidSignature, _forbidden),
    (InvalidKey, _forbidden),
    (ObjectMissing, _no_object),
    (UploadError, _upload_error),
    (StoreUnavailable, _down("object store")),
    (QueueUnavailable, _down("queue")),
    (CatalogUnavailable, _down("catalog")),
    (sqlalchemy.exc.DataError, _unkept),
    (sqlalchemy.exc.TimeoutError, _down("catalog")),  # no free connection
)
