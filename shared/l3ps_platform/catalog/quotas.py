"""How much of what is limited a project has now; to be asked of a scoped catalog."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import JobRow, TrainingRow, UploadRow
from l3ps_platform.catalog.states import ACTIVE, UploadState


def open_uploads(session: Session) -> tuple[int, int]:
    """Uploads that are neither complete nor given up: how many, and the bytes announced."""
    query = select(func.count(UploadRow.id), func.coalesce(func.sum(UploadRow.size), 0))
    count, size = session.execute(query.where(UploadRow.state == UploadState.OPEN)).one()
    return count, int(size)


def active_jobs(session: Session) -> int:
    """Jobs and trainings that are not over."""
    counts = [
        session.scalar(select(func.count()).select_from(kind).where(kind.state.in_(ACTIVE)))
        for kind in (JobRow, TrainingRow)
    ]
    return sum(count or 0 for count in counts)
