"""Queries for jobs and their scenes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, bindparam, case, func, or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import DriveRow, JobRow, ModelRow, SceneRow, StageRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import JobState, StageState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import lowest_id

CLOCKS_DIFFER = timedelta(days=1)
"""At most, those of the API's machine and of the database: ids are made by the first, dates by the second."""


def get(session: Session, id: str) -> JobRow:
    """One job that is not deleted. NotFound."""
    return queries.get(session, JobRow, id)


def lock(session: Session, id: str) -> JobRow:
    """One job, deleted or not, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, JobRow, id)


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which jobs to list; None and nothing mean all.

    Attributes:
        states: in one of these.
        drive_id, model_id: on this drive, with this model.
        created_after, created_before: made at or after, and before.
    """

    states: Collection[JobState] = ()
    drive_id: str | None = None
    model_id: str | None = None
    created_after: datetime | None = None
    created_before: datetime | None = None


def page(session: Session, wanted: Wanted | None = None, *, limit: int = 50, before: str | None = None) -> list[JobRow]:
    """Jobs, newest first, after the cursor ``before`` (the last id of the page before)."""
    return queries.page(session, JobRow, *_conditions(wanted or Wanted()), limit=limit, before=before)


def _conditions(wanted: Wanted) -> list[ColumnElement[bool]]:
    found: list[ColumnElement[bool]] = []
    if wanted.states:
        found.append(JobRow.state.in_(wanted.states))
    if wanted.drive_id is not None:
        found.append(JobRow.drive_id == wanted.drive_id)
    if wanted.model_id is not None:
        found.append(JobRow.model_id == wanted.model_id)
    # Ids sort by time, and pages are in the order of ids: their bounds are what an index can use.
    if wanted.created_after is not None:
        after = _storable(wanted.created_after)
        found += [JobRow.created_at >= after, JobRow.id >= lowest_id("job", after - CLOCKS_DIFFER)]
    if wanted.created_before is not None:
        before = _storable(wanted.created_before)
        found += [JobRow.created_at < before, JobRow.id < lowest_id("job", before + CLOCKS_DIFFER)]
    return found


def _storable(moment: datetime) -> datetime:
    """A moment as far off as anyone may name, brought to where calculating with it does not overflow."""
    return min(max(moment, datetime(1970, 1, 2, tzinfo=UTC)), datetime(9000, 1, 1, tzinfo=UTC))


def revision(session: Session, id: str) -> tuple[Any, ...]:
    """What changes whenever something changes that a client sees of a job, in one query. NotFound.

    Every change of a stage moves it to another state or begins, prolongs or ends an attempt. Two workers that report
    progress in the same moment may look like one; the next report, :attr:`Settings.progress_seconds` later, tells.
    """
    row = session.execute(_REVISION, {"job": id}).one_or_none()
    if row is None:
        raise NotFound(JobRow.noun, id)
    return tuple(row)


_STAGE_STATES = [func.sum(case((StageRow.state == state, 1), else_=0)) for state in StageState]
_REVISION = (
    select(
        *(JobRow.state, JobRow.cancel_requested, JobRow.started_at, JobRow.finished_at, DriveRow.state, ModelRow.state),
        *(DriveRow.name, ModelRow.name, *_STAGE_STATES),
        *(func.sum(column) for column in (StageRow.attempt, StageRow.progress_done, StageRow.fraction)),
        *(func.max(column) for column in (StageRow.started_at, StageRow.finished_at, StageRow.lease_until)),
        func.max(StageRow.queued_at),
    )
    .select_from(JobRow)
    .join(DriveRow, DriveRow.id == JobRow.drive_id)
    .join(ModelRow, ModelRow.id == JobRow.model_id)
    .outerjoin(StageRow, or_(StageRow.job_id == JobRow.id, StageRow.drive_id == JobRow.drive_id))
    .where(JobRow.id == bindparam("job"), JobRow.deleted_at.is_(None))
    .group_by(JobRow.id, DriveRow.id, ModelRow.id)
)


def with_inputs(session: Session, id: str) -> tuple[JobRow, DriveRow, ModelRow]:
    """One job that is not deleted, with its drive and model, which may be. NotFound."""
    row = session.execute(_WITH_INPUTS, {"job": id}).one_or_none()
    if row is None:
        raise NotFound(JobRow.noun, id)
    return row[0], row[1], row[2]


_WITH_INPUTS = (
    select(JobRow, DriveRow, ModelRow)
    .join(DriveRow, DriveRow.id == JobRow.drive_id)
    .join(ModelRow, ModelRow.id == JobRow.model_id)
    .where(JobRow.id == bindparam("job"), JobRow.deleted_at.is_(None))
)


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


def unswept(session: Session, limit: int = 20, after: str = "") -> list[JobRow]:
    """Deleted jobs whose labels are still in the store, after the id ``after``."""
    query = select(JobRow).where(JobRow.deleted_at.is_not(None), JobRow.swept_at.is_(None))
    return list(session.scalars(query.where(JobRow.id > after).order_by(JobRow.id).limit(limit)))
