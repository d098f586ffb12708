"""The queries that every resource of a project has: one by id, one held, a page, several."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.base import Owned
from l3ps_platform.errors import NotFound

Row = TypeVar("Row", bound=Owned)


def get(session: Session, kind: type[Row], id: str) -> Row:
    """One row that is not deleted. NotFound."""
    row = session.scalars(select(kind).where(_column(kind, "id") == id)).one_or_none()
    if row is None or getattr(row, "deleted_at", None) is not None:
        raise NotFound(kind.noun, id)
    return row


def lock(session: Session, kind: type[Row], id: str) -> Row:
    """One row, deleted or not, as it is now and held against concurrent changes until the transaction ends.

    NotFound.
    """
    query = select(kind).where(_column(kind, "id") == id).with_for_update()
    row = session.scalars(query, execution_options={"populate_existing": True}).one_or_none()
    if row is None:
        raise NotFound(kind.noun, id)
    return row


def page(
    session: Session, kind: type[Row], *conditions: ColumnElement[bool], limit: int, before: str | None
) -> list[Row]:
    """Rows that are not deleted and meet the conditions, newest first, after the cursor ``before`` (an id)."""
    query = select(kind).where(*conditions)
    if hasattr(kind, "deleted_at"):
        query = query.where(_column(kind, "deleted_at").is_(None))
    if before is not None:
        query = query.where(_column(kind, "id") < before)
    return list(session.scalars(query.order_by(_column(kind, "id").desc()).limit(limit)))


def many(session: Session, kind: type[Row], ids: Iterable[str | None]) -> dict[str, Row]:
    """Rows by id, deleted ones too; ids without a row are left out."""
    wanted = {id for id in ids if id is not None}
    rows = session.scalars(select(kind).where(_column(kind, "id").in_(wanted)))
    return {row.id: row for row in rows}  # type: ignore[attr-defined]


def _column(kind: type[Row], name: str) -> Any:
    return getattr(kind, name)
