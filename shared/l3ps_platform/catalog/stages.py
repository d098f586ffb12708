"""Queries for stages."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import StageRow, StepRow
from l3ps_platform.catalog.states import StageName
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


def of_scene(session: Session, scene_id: str) -> list[StageRow]:
    """The stages of one scene, in order."""
    return list(session.scalars(select(StageRow).where(StageRow.scene_id == scene_id).order_by(StageRow.id)))


def ingest_of(session: Session, *, drive_id: str | None = None, model_id: str | None = None) -> StageRow | None:
    """The stage that checks a drive or model."""
    query = select(StageRow).where(StageRow.name == StageName.INGEST)
    query = query.where(StageRow.drive_id == drive_id, StageRow.model_id == model_id)
    return session.scalars(query.order_by(StageRow.id.desc()).limit(1)).one_or_none()


def steps(session: Session, stage_ids: Sequence[str]) -> dict[str, list[StepRow]]:
    """What the steps inside each stage cost."""
    found: dict[str, list[StepRow]] = {id: [] for id in stage_ids}
    for row in session.scalars(select(StepRow).where(StepRow.stage_id.in_(stage_ids))):
        found[row.stage_id].append(row)
    return found
