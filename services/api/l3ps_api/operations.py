"""What the API can be asked: its operations by path, from its routes and its OpenAPI document."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute


@dataclass(frozen=True, slots=True)
class Operation:
    """One method of one path.

    Attributes:
        template: the path with its parameters in braces.
        status: of its success.
        query: names of its query parameters.
        repeated: those of them that may be given several times.
        document: whether its answer is JSON.
        resource: whether its answer is a document with an id.
    """

    template: str
    status: int
    query: frozenset[str] = frozenset()
    repeated: frozenset[str] = frozenset()
    document: bool = False
    resource: bool = False


class Operations:
    """All operations of an application; made once all routers are in it."""

    def __init__(self, app: FastAPI) -> None:
        document = app.openapi()
        paths: dict[str, Any] = document["paths"]
        self._found: list[tuple[re.Pattern[str], str, Operation]] = []
        for route in _api_routes(app.routes):
            for method in sorted(route.methods or ()):
                # HEAD is what GET is without its body, and not in the document.
                described = paths.get(route.path_format, {}).get("get" if method == "HEAD" else method.lower(), {})
                operation = _operation(route, described, document["components"]["schemas"])
                self._found.append((route.path_regex, method, operation))
        self.kinds = frozenset(
            match[1] for path, operations in paths.items()
            if "get" in operations and (match := re.fullmatch(r"/v1/([a-z_]+)/\{[a-z_]+\}", path))
        )  # fmt: skip
        """Collections whose members can be asked for by id."""

    def at(self, path: str) -> dict[str, Operation]:
        """The operations of a path by method; empty where there is nothing."""
        found: dict[str, Operation] = {}
        for regex, method, operation in self._found:
            if method not in found and regex.match(path):
                found[method] = operation
        return found


def operations_of(app: FastAPI) -> Operations:
    """The application's operations, collected at the first call."""
    if not hasattr(app.state, "operations"):
        app.state.operations = Operations(app)
    found: Operations = app.state.operations
    return found


def _api_routes(routes: Iterable[BaseRoute]) -> Iterator[APIRoute]:
    for route in routes:
        router = getattr(route, "original_router", None)  # an included router
        if isinstance(route, APIRoute):
            yield route
        elif router is not None:
            yield from _api_routes(router.routes)


def _operation(route: APIRoute, described: dict[str, Any], schemas: dict[str, Any]) -> Operation:
    query = [parameter for parameter in described.get("parameters", ()) if parameter.get("in") == "query"]
    status = route.status_code or 200
    content = described.get("responses", {}).get(str(status), {}).get("content", {})
    answer = content.get("application/json", {})
    return Operation(
        route.path_format,
        status,
        frozenset(parameter["name"] for parameter in query),
        frozenset(parameter["name"] for parameter in query if "array" in str(parameter["schema"])),
        "application/json" in content,
        _has_id(answer.get("schema", {}), schemas),
    )


def _has_id(schema: dict[str, Any], schemas: dict[str, Any]) -> bool:
    if "anyOf" in schema:
        return all(_has_id(each, schemas) for each in schema["anyOf"])
    found = schemas.get(schema.get("$ref", "").rpartition("/")[2], schema)
    return "id" in found.get("properties", {})
