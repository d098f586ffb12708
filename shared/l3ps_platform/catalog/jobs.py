"""Queries for jobs and their scenes."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import JobRow, SceneRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import JobState
from l3ps_platform.errors import Conflict, NotFound


def get(session: Session, id: str) -> JobRow:
    """One job that is not deleted. NotFound."""
    return queries.get(session, JobRow, id)


def lock(session: Session, id: str) -> JobRow:
    """One job, deleted or not, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, JobRow, id)


def page(
    session: Session, *, limit: int = 50, before: str | None = None, state: JobState | None = None
) -> list[JobRow]:
    """Jobs, newest first, after the cursor ``before`` (the last id of the page before)."""
    wanted = [JobRow.state == state] if state is not None else []
    return queries.page(session, JobRow, *wanted, limit=limit, before=before)


def scenes(session: Session, job_id: str) -> list[SceneRow]:
    """A job's scenes in the log's order."""
    return list(session.scalars(select(SceneRow).where(SceneRow.job_id == job_id).order_by(SceneRow.position)))


def unplanned(session: Session, *, drive_id: str | None = None, model_id: str | None = None) -> Sequence[JobRow]:
    """Queued jobs of a drive or model that have no scenes yet, because the drive or model is still being checked."""
    query = select(JobRow).where(JobRow.state == JobState.QUEUED, JobRow.cancel_requested.is_(False))
    query = query.where(JobRow.id.not_in(select(SceneRow.job_id)))
    if drive_id is not None:
        query = query.where(JobRow.drive_id == drive_id)
    if model_id is not None:
        query = query.where(JobRow.model_id == model_id)
    return list(session.scalars(query.order_by(JobRow.id).with_for_update()))


def delete(tx: Transaction, id: str) -> JobRow:
    """Hide a finished job, whose labels the reconciler then deletes. NotFound, Conflict while it is not over."""
    row = lock(tx.session, id)
    if row.deleted_at is not None:
        raise NotFound("job", id)
    if not row.state.final:
        raise Conflict(f"job {id} is {row.state}: cancel it first, then delete it")
    row.deleted_at = tx.now
    tx.session.flush()
    return row


def unswept(session: Session, limit: int = 20) -> list[JobRow]:
    """Deleted jobs whose labels are still in the store."""
    query = select(JobRow).where(JobRow.deleted_at.is_not(None), JobRow.swept_at.is_(None))
    return list(session.scalars(query.order_by(JobRow.deleted_at).limit(limit)))
