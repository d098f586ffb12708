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
from l3ps_api.problems import ApiProblem, ErrorItem, answer, conflict, items, unavailable, unknown
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


def install(app: FastAPI) -> None:
    """Register the handlers; to be called before other middleware is added, which then sees these answers."""
    app.add_middleware(UnexpectedErrors)
    for kind, translate in _TRANSLATIONS:
        app.add_exception_handler(kind, _handler(translate))


class UnexpectedErrors:
    """Answers with a problem document where nothing else caught an exception, and logs it once.

    A handler for ``Exception`` would not do: Starlette raises it again after the answer, upon which the server closes
    the connection under a client that may already be sending its next request.
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
            log.error("request failed", method=scope["method"], path=scope["path"], exc_info=error)
            detail = "The service failed at this request; the fault is in the service. Its log says more."
            problem = ApiProblem(500, "internal", "Internal error", detail)
            await answer(problem, scope["path"])(scope, receive, send)


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
    name = ".".join(names)
    where = name if place == "body" and name else f"{place} {name}".rstrip()
    what = str(fault["msg"])
    what = what[:1].lower() + what[1:]
    if kind == "missing":
        return ErrorItem(where=where, what="the field is missing", remedy="Add it.")
    if kind == "extra_forbidden":
        return ErrorItem(where=where, what="there is no such field", remedy="Remove it or correct its name.")
    return ErrorItem(where=where, what=what, remedy="/openapi.json says what this field takes.")


def _http_error(request: Request, error: HTTPException) -> ApiProblem:
    status = HTTPStatus(error.status_code)
    path = request.url.path
    detail = str(error.detail)
    errors = []
    if status == HTTPStatus.NOT_FOUND:
        detail = f"There is nothing at {path}. /openapi.json lists every path."
        errors = [ErrorItem(where="path", what=f"{path} does not exist", remedy="Use a path of /openapi.json.")]
    elif status == HTTPStatus.METHOD_NOT_ALLOWED:
        allowed = (error.headers or {}).get("Allow", "another method")
        detail = f"{request.method} does not work on {path}; it takes {allowed}."
        errors = [ErrorItem(where="method", what=f"{request.method} is not allowed", remedy=f"Use {allowed}.")]
    code = status.phrase.lower().replace(" ", "-")
    return ApiProblem(status, code, status.phrase, detail, errors, headers=error.headers)


def _bad_input(_: Request, error: InputError) -> ApiProblem:
    return ApiProblem(422, "bad-input", "The input cannot be used", str(error), items(error.problems))


def _not_found(request: Request, error: NotFound) -> ApiProblem:
    in_path = error.id in request.path_params.values()
    return unknown(error.kind, error.id, "path" if in_path else {"drive": "drive_id"}.get(error.kind, error.kind))


def _conflict(_: Request, error: Conflict) -> ApiProblem:
    return conflict("conflict", "Not possible in the present state", _sentence(error))


def _forbidden(_: Request, error: InvalidSignature | InvalidKey) -> ApiProblem:
    return ApiProblem(403, "invalid-signature", "The URL does not permit this", _sentence(error))


def _no_object(_: Request, error: ObjectMissing) -> ApiProblem:
    return ApiProblem(404, "unknown-object", "Unknown object", f"{_sentence(error)} Ask the API for a new URL.")


def _upload_error(_: Request, error: UploadError) -> ApiProblem:
    return ApiProblem(409, "upload-closed", "The upload is closed", _sentence(error))


def _down(what: str) -> Callable[[Request, Exception], ApiProblem]:
    def translate(_: Request, error: Exception) -> ApiProblem:
        log.warning(f"{what} unavailable", reason=str(error))
        return unavailable(what)

    return translate


def _sentence(error: Exception) -> str:
    text = str(error)
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


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
    (sqlalchemy.exc.TimeoutError, _down("catalog")),  # no free connection
)
