"""What all groups of resources share: paths made of ids, and pages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

from l3ps_client._documents import Page
from l3ps_client._wire import Wire

MOST_PER_PAGE = 200


class Group:
    """The methods of one resource."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire


def path(*segments: str) -> str:
    """A path under /v1; a segment is an id or name and never more than one step of the path."""
    return "/v1/" + "/".join(quote(segment, safe="") for segment in segments)


def items(wire: Wire, where: str, limit: int | None, **params: Any) -> Iterator[Any]:
    """All items over all pages, or the first ``limit``, fetched as they are asked for."""
    cursor: str | None = None
    left = limit
    while left is None or left > 0:
        page: Page[Any] = wire.get(where, limit=min(left or MOST_PER_PAGE, MOST_PER_PAGE), cursor=cursor, **params)
        yield from page["items"]
        left = None if left is None else left - len(page["items"])
        cursor = page.get("next")
        if not cursor:
            return
