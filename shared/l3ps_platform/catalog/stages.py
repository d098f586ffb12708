"""Queries for stages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime

from sqlalchemy import case, func, or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import JobRow, StageRow, StepRow, TrainingRow
from l3ps_platform.catalog.states import QUEUE_OF, QueueName, StageName, StageState
from l3ps_platform.errors import NotFound


def get(session: Session, id: str) -> StageRow:
    """One stage. NotFound."""
    row = session.get(StageRow, id)
    if row is None:
        raise NotFound("stage", id)
    return row


def of_job(session: Session, job_id: str) -> list[StageRow]:
    """All stages of a job, its scenes' and its own, in the order they were planned."""
    return list(session.scalars(select(StageRow).where(StageRow.job_id == job_id).order_by(StageRow.id)))


def publishing(session: Session, job_id: str) -> StageRow | None:
    """The stage that publishes a job, where it has been planned."""
    query = select(StageRow).where(StageRow.job_id == job_id, StageRow.name == StageName.PUBLISH)
    return session.scalars(query).one_or_none()


def of_job_and_drive(session: Session, job_id: str, drive_id: str) -> list[StageRow]:
    """The stages that a job's client sees: the check of its drive, and :func:`of_job`."""
    seen = or_(StageRow.job_id == job_id, StageRow.drive_id == drive_id)
    return list(session.scalars(select(StageRow).where(seen).order_by(StageRow.id)))


def of_scene(session: Session, scene_id: str) -> list[StageRow]:
    """The stages of one scene, in order."""
    return list(session.scalars(select(StageRow).where(StageRow.scene_id == scene_id).order_by(StageRow.id)))


def of_training(session: Session, training_id: str) -> StageRow:
    """The stage of a training. NotFound."""
    row = session.scalars(select(StageRow).where(StageRow.training_id == training_id)).one_or_none()
    if row is None:
        raise NotFound("training", training_id)
    return row


def of_trainings(session: Session, training_ids: Iterable[str]) -> dict[str, StageRow]:
    """The stage of each training."""
    rows = session.scalars(select(StageRow).where(StageRow.training_id.in_(set(training_ids))))
    return {row.training_id: row for row in rows if row.training_id is not None}


def progress(session: Session, job_ids: Iterable[str]) -> dict[str, tuple[float, int]]:
    """For each job how much of its stages is done, the running ones by their fraction, and how many there are."""
    final = StageRow.state.in_([state for state in StageState if state.final])
    share = case((final, 1.0), (StageRow.state == StageState.RUNNING, StageRow.fraction), else_=0.0)
    query = select(StageRow.job_id, func.sum(share), func.count()).where(StageRow.job_id.in_(set(job_ids)))
    rows = session.execute(query.group_by(StageRow.job_id))
    return {job_id: (float(done), count) for job_id, done, count in rows if job_id is not None}


def ingest_of(session: Session, *, drive_id: str | None = None, model_id: str | None = None) -> StageRow | None:
    """The stage that checks a drive or model."""
    query = select(StageRow).where(StageRow.name == StageName.INGEST)
    query = query.where(StageRow.drive_id == drive_id, StageRow.model_id == model_id)
    return session.scalars(query.order_by(StageRow.id.desc()).limit(1)).one_or_none()


def owned(session: Session, owner_prefix: str) -> list[tuple[str, str]]:
    """(id, owner) of the running stages whose owner's name begins so."""
    query = select(StageRow.id, StageRow.lease_owner).where(
        StageRow.state == StageState.RUNNING, StageRow.lease_owner.startswith(owner_prefix, autoescape=True)
    )
    return [(id, owner) for id, owner in session.execute(query) if owner is not None]


def cancelled_of(session: Session, owner_prefix: str) -> list[tuple[str, str, StageName]]:
    """(id, owner, name) of the running stages whose owner's name begins so and whose job or training is to stop.

    Their rows are held until the transaction ends, so that no owner can go on to another stage meanwhile.
    """
    asked = or_(JobRow.cancel_requested.is_(True), TrainingRow.cancel_requested.is_(True))
    query = (
        select(StageRow.id, StageRow.lease_owner, StageRow.name)
        .outerjoin(JobRow, JobRow.id == StageRow.job_id)
        .outerjoin(TrainingRow, TrainingRow.id == StageRow.training_id)
        .where(StageRow.state == StageState.RUNNING, asked)
        .where(StageRow.lease_owner.startswith(owner_prefix, autoescape=True))
        .order_by(StageRow.id)
    )
    rows = session.execute(query.with_for_update(of=StageRow))
    return [(id, owner, name) for id, owner, name in rows if owner is not None]


def overdue(session: Session, queue: QueueName, before: datetime) -> list[tuple[str, int]]:
    """(id, attempt) of the stages that have waited in a queue since before then, the longest waiting first."""
    names = [name for name, where in QUEUE_OF.items() if where is queue]  # the index has names
    query = select(StageRow.id, StageRow.attempt).where(
        StageRow.state == StageState.QUEUED, StageRow.name.in_(names), StageRow.queued_at < before
    )
    return [(id, attempt) for id, attempt in session.execute(query.order_by(StageRow.queued_at, StageRow.id))]


def hold_overdue(session: Session, ids: Sequence[str], before: datetime) -> list[StageRow]:
    """Those of the stages that still wait since before then, held; none that somebody else holds."""
    query = select(StageRow).where(
        StageRow.id.in_(ids), StageRow.state == StageState.QUEUED, StageRow.queued_at < before
    )
    return list(session.scalars(query.order_by(StageRow.queued_at, StageRow.id).with_for_update(skip_locked=True)))


def steps(session: Session, stage_ids: Sequence[str]) -> dict[str, list[StepRow]]:
    """What the steps inside each stage cost."""
    found: dict[str, list[StepRow]] = {id: [] for id in stage_ids}
    for row in session.scalars(select(StepRow).where(StepRow.stage_id.in_(stage_ids))):
        found[row.stage_id].append(row)
    return found
