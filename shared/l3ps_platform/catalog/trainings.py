"""Queries for trainings."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import StageRow, TrainingRow
from l3ps_platform.catalog.output_rows import OutputUseRow
from l3ps_platform.catalog.states import ACTIVE, JobState


def get(session: Session, id: str) -> TrainingRow:
    """One training. NotFound."""
    return queries.get(session, TrainingRow, id)


def lock(session: Session, id: str) -> TrainingRow:
    """One training, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, TrainingRow, id)


def page(
    session: Session, *, limit: int = 50, before: str | None = None, state: JobState | None = None
) -> list[TrainingRow]:
    """Trainings, newest first, after the cursor ``before`` (the last id of the page before)."""
    wanted = [TrainingRow.state == state] if state is not None else []
    return queries.page(session, TrainingRow, *wanted, limit=limit, before=before)


def unfinished(session: Session, name: str) -> TrainingRow | None:
    """The training that is to become the model of this name and is not over, if there is one."""
    query = select(TrainingRow).where(TrainingRow.name == name, TrainingRow.state.in_(ACTIVE))
    return session.scalars(query.order_by(TrainingRow.id).limit(1)).one_or_none()


def of_model(session: Session, model_id: str) -> TrainingRow | None:
    """The training that a model came from, if it came from one."""
    return session.scalars(select(TrainingRow).where(TrainingRow.model_id == model_id).limit(1)).one_or_none()


def holding_outputs(session: Session, ended_before: datetime, limit: int = 20, after: str = "") -> list[TrainingRow]:
    """Trainings that ended before then and still hold their outputs in the store, after the id ``after``."""
    query = select(TrainingRow).join(StageRow, StageRow.training_id == TrainingRow.id)
    query = query.join(OutputUseRow, OutputUseRow.stage_id == StageRow.id)
    query = query.where(TrainingRow.state.not_in(ACTIVE), TrainingRow.finished_at < ended_before).distinct()
    return list(session.scalars(query.where(TrainingRow.id > after).order_by(TrainingRow.id).limit(limit)))
