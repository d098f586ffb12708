"""Queries for the event log."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.event_rows import EventRow
from l3ps_platform.catalog.kinds import EventKind


def after(
    session: Session,
    seq: int,
    *,
    limit: int = 500,
    subject: str | None = None,
    kinds: Collection[EventKind] | None = None,
) -> list[EventRow]:
    """Events that follow number ``seq``, in order; only of one subject or of some kinds."""
    query = select(EventRow).where(EventRow.seq > seq)
    if subject is not None:
        query = query.where(EventRow.subject_id == subject)
    if kinds is not None and len(kinds) < len(EventKind):
        query = query.where(EventRow.kind.in_(kinds))
    return list(session.scalars(query.order_by(EventRow.seq).limit(limit)))


def last_seq(session: Session) -> int:
    """The number of the latest event of any project, 0 before the first one."""
    # By its column alone: a project's reader must know how far the log goes, not only its own part.
    return session.scalar(select(func.max(EventRow.__table__.c.seq))) or 0


def prune(session: Session, before: datetime) -> None:
    """Forget what happened before a date."""
    session.execute(delete(EventRow).where(EventRow.created_at < before))
