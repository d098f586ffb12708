"""How much of what is limited a project has now; to be asked of a scoped catalog."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import JobRow, TrainingRow, UploadRow
from l3ps_platform.catalog.states import ACTIVE, UploadState


def open_uploads(session: Session) -> int:
    """Uploads that are neither complete nor given up."""
    return session.scalar(select(func.count()).select_from(UploadRow).where(UploadRow.state == UploadState.OPEN)) or 0


def active_jobs(session: Session) -> int:
    """Jobs and trainings that are not over."""
    counts = [
        session.scalar(select(func.count()).select_from(kind).where(kind.state.in_(ACTIVE)))
        for kind in (JobRow, TrainingRow)
    ]
    return sum(count or 0 for count in counts)
