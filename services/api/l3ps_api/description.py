"""What ``/openapi.json`` says beyond what the routes say themselves: errors, and headers that all operations share."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from l3ps_api.auth import PROJECT_HEADER, guarded
from l3ps_api.problems import MEDIA_TYPE, ProblemDocument

_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}}
_ERRORS = {
    "401": "The credentials are missing or not valid.",
    "403": "The credentials, or the signature of the URL, do not permit this.",
    "404": "There is no such resource, or not in this project.",
    "408": "The body did not come in time.",
    "409": "Not possible in the present state of things; or a request with this Idempotency-Key is in progress.",
    "412": "The document has another ETag than `If-Match` names.",
    "413": "The body, or the file announced, is too large.",
    "416": "The document has no such range of bytes.",
    "422": "The request cannot be used; `errors` names the fields at fault.",
    "429": "Too many requests, or a quota is reached; `Retry-After` says when to ask again.",
    "503": "Something the service stands on does not answer; `Retry-After` says when to ask again.",
}
_HEADERS = {
    "Project": (PROJECT_HEADER, r"^prj_[a-z0-9]{1,28}$", "The operator's choice of project; a key has its own."),
    "IdempotencyKey": (
        "Idempotency-Key", r"^[\x20-\x7e]{1,255}$",
        "Makes repeating safe: the same key with the same request is done once and answered alike for a day.",
    ),
    "IfNoneMatch": ("If-None-Match", None, "ETag of what the client has; 304 if it is still that."),
    "IfMatch": ("If-Match", None, "ETag of what the client has seen; 412 if it has changed since."),
}  # fmt: skip


def describe(app: FastAPI) -> None:
    """Have every operation name the errors that it answers with, as problem documents, and the headers it heeds."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = generate()
            _components(schema.setdefault("components", {}))
            for path, operations in schema["paths"].items():
                for method, operation in operations.items():
                    _complete(path, method, operation)
        return app.openapi_schema or schema

    app.openapi = openapi  # type: ignore[method-assign]


def _components(components: dict[str, Any]) -> None:
    schemas = components.setdefault("schemas", {})
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    document = ProblemDocument.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= document.pop("$defs")
    schemas["ProblemDocument"] = document
    components["responses"] = {
        f"Problem{status}": {"description": text, "content": _CONTENT} for status, text in _ERRORS.items()
    }
    components["parameters"] = {
        name: {
            "name": header, "in": "header", "required": False, "description": text,
            "schema": {"type": "string"} | ({"pattern": pattern} if pattern else {}),
        }
        for name, (header, pattern, text) in _HEADERS.items()
    }  # fmt: skip


def _complete(path: str, method: str, operation: dict[str, Any]) -> None:
    responses = operation["responses"]
    responses.pop("422", None)
    document = method == "get" and "application/json" in responses.get("200", {}).get("content", {})
    if guarded(path):
        headers = ["Project"]
        errors = {"401", "403", "422", "429", "503"}
        if method == "get":
            headers += ["IfNoneMatch"] if document else []
        elif method == "post":
            headers += ["IdempotencyKey"]
            errors |= {"404", "408", "409", "413"}
        else:
            headers += ["IfMatch"]
            errors |= {"404", "408", "409", "412", "413"}
        if "{" in path or not document:
            errors |= {"404", "409"}
        if "206" in responses:
            errors |= {"416"}
        if document:
            responses["304"] = {"description": "The client has it already."}
        references = [{"$ref": f"#/components/parameters/{name}"} for name in headers]
        operation["parameters"] = [*operation.get("parameters", ()), *references]
    elif path.startswith("/v1/objects/"):
        errors = {"403", "404", "409", "413", "422", "503"}
    else:
        errors = {"/readyz": {"503"}, "/metrics": {"401"}}.get(path, set())
    for status in sorted(errors):
        responses.setdefault(status, {"$ref": f"#/components/responses/Problem{status}"})
    responses["default"] = {"description": "Any other error.", "content": _CONTENT}
