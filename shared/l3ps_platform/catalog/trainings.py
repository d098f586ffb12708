"""Queries for trainings."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import TrainingRow
from l3ps_platform.catalog.states import ACTIVE, JobState
from l3ps_platform.errors import NotFound


def get(session: Session, id: str) -> TrainingRow:
    """One training. NotFound."""
    row = session.get(TrainingRow, id)
    if row is None:
        raise NotFound("training", id)
    return row


def lock(session: Session, id: str) -> TrainingRow:
    """One training, held against concurrent changes until the transaction ends. NotFound."""
    query = select(TrainingRow).where(TrainingRow.id == id).with_for_update()
    row = session.scalars(query, execution_options={"populate_existing": True}).one_or_none()
    if row is None:
        raise NotFound("training", id)
    return row


def page(
    session: Session, *, limit: int = 50, before: str | None = None, state: JobState | None = None
) -> list[TrainingRow]:
    """Trainings, newest first, after the cursor ``before`` (the last id of the page before)."""
    query = select(TrainingRow)
    if before is not None:
        query = query.where(TrainingRow.id < before)
    if state is not None:
        query = query.where(TrainingRow.state == state)
    return list(session.scalars(query.order_by(TrainingRow.id.desc()).limit(limit)))


def unfinished(session: Session, name: str) -> TrainingRow | None:
    """The training that is to become the model of this name and is not over, if there is one."""
    query = select(TrainingRow).where(TrainingRow.name == name, TrainingRow.state.in_(ACTIVE))
    return session.scalars(query.order_by(TrainingRow.id).limit(1)).one_or_none()


def of_model(session: Session, model_id: str) -> TrainingRow | None:
    """The training that a model came from, if it came from one."""
    return session.scalars(select(TrainingRow).where(TrainingRow.model_id == model_id).limit(1)).one_or_none()
