"""Every error the API answers with: RFC 9457 problem documents that name the field at fault and the remedy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field

from l3ps.errors import Problem

MEDIA_TYPE = "application/problem+json"


class ErrorItem(BaseModel):
    """One thing wrong with a request or with what it refers to."""

    where: str = Field(description="Field of the request, or file or table inside a drive log.")
    what: str = Field(description="What is wrong, with the values seen and expected.")
    remedy: str = Field(description="What to do about it.")
    code: str | None = Field(default=None, description="Stable machine-readable name, where there is one.")
    severity: str | None = Field(default=None, description="`error`, `scan` or `warning` for problems of a drive log.")
    scene: str | None = Field(default=None, description="Scene of the drive log concerned.")
    scan: str | None = Field(default=None, description="Scan of the drive log concerned.")


class ProblemDocument(BaseModel):
    """An error, as RFC 9457 defines it."""

    type: str = Field(description="Stable name of the kind of problem.", examples=["urn:l3ps:problem:unknown-job"])
    title: str = Field(description="The kind of problem in words.")
    status: int = Field(description="HTTP status.")
    detail: str = Field(description="What happened here and what to do, one sentence each.")
    instance: str = Field(description="Path of the request.")
    errors: list[ErrorItem] = Field(default_factory=list)


class ApiProblem(Exception):  # noqa: N818  (it becomes a problem document)
    """Raised anywhere below a route to answer with a problem document.

    Args:
        status: HTTP status.
        code: stable name in kebab-case, the end of the document's ``type``.
        title: the kind of problem.
        detail: what happened and, in its last sentence, what to do.
        errors: the single faults with the fields they are about; without them the detail stands for the one.
        headers: further response headers.
    """

    def __init__(
        self,
        status: int,
        code: str,
        title: str,
        detail: str,
        errors: Iterable[ErrorItem] = (),
        *,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status, self.code, self.title, self.detail = status, code, title, detail
        self.errors = list(errors) or [_from_detail(detail)]
        self.headers = dict(headers or {})


def _from_detail(detail: str) -> ErrorItem:
    what, _, remedy = detail.rpartition(". ")
    return ErrorItem(where="request", what=what or detail, remedy=remedy if what else "See /openapi.json.")


def fault(
    status: int, code: str, title: str, where: str, what: str, remedy: str, headers: Mapping[str, str] | None = None
) -> ApiProblem:
    """A problem with one fault: ``where`` it is, ``what`` is wrong and the remedy."""
    error = ErrorItem(where=where, what=what, remedy=remedy)
    return ApiProblem(status, code, title, f"{where}: {what}. {remedy}", [error], headers=headers)


def items(problems: Iterable[Problem]) -> list[ErrorItem]:
    """Problems found in a drive log or model bundle as the errors of a document."""
    return [ErrorItem.model_validate(problem.as_dict()) for problem in problems]


def stored_items(problems: Iterable[Mapping[str, Any]] | None) -> list[ErrorItem]:
    """The same from the catalog's JSON."""
    return [ErrorItem.model_validate(problem) for problem in problems or ()]


def unknown(kind: str, identifier: str, where: str = "path") -> ApiProblem:
    """404 for an id that names nothing; ``where`` it was given."""
    all_of_them = f"/v1/{kind.removesuffix('s')}s"
    return ApiProblem(
        404,
        f"unknown-{kind}",
        f"Unknown {kind}",
        f"There is no {kind} {identifier!r}. GET {all_of_them} lists those there are.",
        [ErrorItem(where=where, what=f"no {kind} has the id {identifier!r}", remedy=f"Use an id from {all_of_them}.")],
    )


def conflict(code: str, title: str, detail: str, *, where: str = "", remedy: str = "") -> ApiProblem:
    """409: the request is sound but not in the present state of things; ``detail`` ends with what to do."""
    errors = [ErrorItem(where=where, what=detail, remedy=remedy)] if where else []
    return ApiProblem(409, code, title, detail, errors)


def invalid(where: str, what: str, remedy: str, *, code: str = "invalid-request") -> ApiProblem:
    """422 that names one field."""
    return fault(422, code, "The request cannot be used", where, what, remedy)


def too_large(where: str, what: str, remedy: str) -> ApiProblem:
    """413."""
    return fault(413, "too-large", "Too large", where, what, remedy)


def unavailable(what: str, seconds: int = 5) -> ApiProblem:
    """503 for a catalog, store or queue that does not answer."""
    code, remedy = f"{what.replace(' ', '-')}-unavailable", f"Try again in {seconds} seconds."
    detail = f"The {what} does not answer just now; nothing was changed. {remedy}"
    error = ErrorItem(where=what, what="it does not answer just now", remedy=remedy)
    return ApiProblem(503, code, "Temporarily unavailable", detail, [error], headers={"Retry-After": str(seconds)})


def answer(problem: ApiProblem, instance: str) -> JSONResponse:
    """The response for a problem."""
    document = ProblemDocument(
        type=f"urn:l3ps:problem:{problem.code}",
        title=problem.title,
        status=problem.status,
        detail=problem.detail,
        instance=instance,
        errors=problem.errors,
    )
    return JSONResponse(
        document.model_dump(exclude_none=True), problem.status, headers=problem.headers, media_type=MEDIA_TYPE
    )
