"""Lists are asked for one row beyond the page: that row says whether there is a next page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar


class Named(Protocol):
    """A row with an id."""

    id: str


Row = TypeVar("Row", bound=Named)


def cut(rows: Sequence[Row], limit: int) -> tuple[Sequence[Row], str | None]:
    """The rows to show, and the cursor of the next page; None on the last.

    Args:
        rows: up to ``limit + 1`` of them.
        limit: how many a page has at most.
    """
    shown = rows[:limit]
    return shown, shown[-1].id if len(rows) > limit else None
