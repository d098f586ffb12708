"""Queries for rows that nobody asks for any more."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import delete, or_, select, update
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import TrainingRow, UploadRow
from l3ps_platform.catalog.source_rows import ArrivalRow
from l3ps_platform.catalog.states import ACTIVE, UploadState


def uploads(session: Session, before: datetime, limit: int) -> int:
    """Forget uploads that began before then and are over, with nothing of theirs in the store; how many."""
    over = or_(
        UploadRow.state == UploadState.COMPLETE,
        (UploadRow.state == UploadState.ABORTED) & (UploadRow.s3_upload_id == ""),
    )
    return _delete(session, UploadRow, UploadRow.created_at < before, over, limit=limit)


def arrivals(session: Session, before: datetime, limit: int) -> int:
    """Forget arrivals that were settled before then; how many. One that is told of again then is a new one."""
    return _delete(session, ArrivalRow, ArrivalRow.settled_at < before, limit=limit)


def training_logs(session: Session, before: datetime, limit: int) -> int:
    """Give up the logs of trainings that ended before then; how many.

    Their objects belong to nobody then, but for those that lie beside a model's bundle.
    """
    old = select(TrainingRow.id).where(
        TrainingRow.log_key.is_not(None), TrainingRow.finished_at < before, TrainingRow.state.not_in(ACTIVE)
    )
    given_up = update(TrainingRow).where(TrainingRow.id.in_(old.limit(limit))).values(log_key=None)
    return len(session.scalars(given_up.returning(TrainingRow.id)).all())


def _delete(session: Session, kind: Any, *conditions: Any, limit: int) -> int:
    some = select(kind.id).where(*conditions).limit(limit)
    return len(session.scalars(delete(kind).where(kind.id.in_(some)).returning(kind.id)).all())
