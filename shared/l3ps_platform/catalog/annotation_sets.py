"""Queries for archives of annotated images."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import AnnotationsRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import ACTIVE
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id


def add(
    tx: Transaction, *, name: str, filename: str, size: int, object_key: str, sha256: str | None = None
) -> AnnotationsRow:
    """A new archive; ``sha256`` as the client claims it."""
    row = AnnotationsRow(
        id=new_id("ann"),
        name=name,
        filename=filename,
        sha256=sha256,
        size=size,
        object_key=object_key,
        created_at=tx.now,
    )
    tx.session.add(row)
    tx.session.flush()
    return row


def get(session: Session, id: str) -> AnnotationsRow:
    """One archive that is not deleted. NotFound."""
    return queries.get(session, AnnotationsRow, id)


def lock(session: Session, id: str) -> AnnotationsRow:
    """One archive that is not deleted, held against concurrent changes until the transaction ends. NotFound."""
    row = queries.lock(session, AnnotationsRow, id)
    if row.deleted_at is not None:
        raise NotFound("annotations", id)
    return row


def page(
    session: Session, *, limit: int = 50, before: str | None = None, sha256: str | None = None
) -> list[AnnotationsRow]:
    """Archives that are not deleted, newest first, after the cursor ``before`` (the last id of the page before)."""
    wanted = [AnnotationsRow.sha256 == sha256] if sha256 is not None else []
    return queries.page(session, AnnotationsRow, *wanted, limit=limit, before=before)


def many(session: Session, ids: Iterable[str | None]) -> dict[str, AnnotationsRow]:
    """Archives by id, deleted ones too; ids without a row are left out."""
    return queries.many(session, AnnotationsRow, ids)


def delete(tx: Transaction, id: str) -> AnnotationsRow:
    """Hide an archive; models trained on it stay. NotFound, Conflict while a training uses it.

    The reconciler deletes the bytes: :func:`leftover_archives`.
    """
    row = lock(tx.session, id)
    uses = or_(TrainingRow.annotations_id == id, TrainingRow.validation_id == id)
    user = tx.session.scalar(select(TrainingRow.id).where(uses, TrainingRow.state.in_(ACTIVE)).limit(1))
    if user is not None:
        raise Conflict(f"annotations {id} are used by training {user}: cancel it or wait for its end")
    row.deleted_at = tx.now
    tx.session.flush()
    return row


def leftover_archives(session: Session, limit: int = 100, after: str = "") -> list[AnnotationsRow]:
    """Deleted ones whose archive is still in the store, after the id ``after``."""
    gone = (AnnotationsRow.deleted_at.is_not(None), AnnotationsRow.object_key.is_not(None))
    query = select(AnnotationsRow).where(*gone, AnnotationsRow.id > after).order_by(AnnotationsRow.id)
    return list(session.scalars(query.limit(limit)))
