"""Queries for what a project keeps and what goes first."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ColumnElement, exists, func, or_, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import DriveRow, JobRow, ProjectRow
from l3ps_platform.catalog.output_rows import RetentionRow
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.catalog.states import ACTIVE, DriveState


def get(session: Session) -> RetentionRow | None:
    """The limits of the session's project; None where nobody set any."""
    return session.scalars(select(RetentionRow).where(RetentionRow.id == project_of(session))).one_or_none()


def put(tx: Transaction, *, max_age_days: int | None, max_bytes: int | None) -> RetentionRow:
    """Set the limits of the transaction's project."""
    project_id = project_of(tx.session)
    limits = {"max_age_days": max_age_days, "max_bytes": max_bytes}
    insert = postgresql.insert if tx.session.get_bind().dialect.name == "postgresql" else sqlite.insert
    statement = insert(RetentionRow).values(id=project_id, project_id=project_id, **limits)
    # One statement: of two that found no row, the second to add one would fail.
    tx.session.execute(statement.on_conflict_do_update(index_elements=["id"], set_=limits))
    found = select(RetentionRow).where(RetentionRow.id == project_id).execution_options(populate_existing=True)
    return tx.session.scalars(found).one()


def limited(session: Session) -> list[RetentionRow]:
    """The limits of every project that has one."""
    query = select(RetentionRow).where(or_(RetentionRow.max_age_days.is_not(None), RetentionRow.max_bytes.is_not(None)))
    return list(session.scalars(query.order_by(RetentionRow.id)))


def oldest(
    session: Session, project_id: str, *, before: datetime | None = None, limit: int
) -> list[tuple[datetime, JobRow | DriveRow]]:
    """What may go, the longest unused first: finished jobs, and drives that no unfinished job refers to.

    Args:
        session: the session.
        project_id: whose.
        before: only what was last used before then: a job at its end, a drive at the end of its last job or, where it
            has none, at its arrival.
        limit: how many at most.
    """
    jobs = select(JobRow.finished_at, JobRow).where(
        JobRow.project_id == project_id, JobRow.deleted_at.is_(None), JobRow.finished_at.is_not(None), ~_active()
    )
    used = select(func.max(JobRow.finished_at)).where(JobRow.drive_id == DriveRow.id).scalar_subquery()
    last = func.coalesce(used, DriveRow.created_at, type_=DriveRow.created_at.type)
    drives = select(last, DriveRow).where(
        DriveRow.project_id == project_id,
        DriveRow.deleted_at.is_(None),
        DriveRow.object_key.is_not(None),
        DriveRow.state == DriveState.READY,
        ~exists().where(JobRow.drive_id == DriveRow.id, _active()),
    )
    if before is not None:
        jobs, drives = jobs.where(JobRow.finished_at < before), drives.where(last < before)
    found: list[tuple[datetime, JobRow | DriveRow]] = []
    for at, job in session.execute(jobs.order_by(JobRow.finished_at, JobRow.id).limit(limit)):
        found.append((at or job.created_at, job))
    for at, drive in session.execute(drives.order_by(last, DriveRow.id).limit(limit)):
        found.append((at or drive.created_at, drive))
    return sorted(found, key=lambda item: (item[0], item[1].id))[:limit]


def of_closed_projects(session: Session, limit: int) -> list[JobRow]:
    """Jobs of projects that were deleted: nobody can ask for their labels any more."""
    query = select(JobRow).join(ProjectRow, ProjectRow.id == JobRow.project_id)
    query = query.where(ProjectRow.deleted_at.is_not(None), JobRow.deleted_at.is_(None))
    return list(session.scalars(query.limit(limit)))


def _active() -> ColumnElement[bool]:
    return JobRow.state.in_(ACTIVE)
