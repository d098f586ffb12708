"""Sums over the catalog for the metrics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import JobRow, StageRow, StepRow, TrainingRow
from l3ps_platform.catalog.states import JobState, QueueName, StageName, StageState


@dataclass(frozen=True, slots=True)
class StageFigures:
    """Sums over the finished stages of one name; what came from the cache was not computed and does not count.

    Attributes:
        count: stages.
        seconds, cpu_seconds: sums.
        peak_mb: the highest.
        scans, points: sums.
        within: for each bound the number of stages that took at most so many seconds.
    """

    count: int
    seconds: float
    cpu_seconds: float
    peak_mb: float
    scans: int
    points: int
    within: tuple[int, ...]


def stage_figures(session: Session, bounds: Sequence[float]) -> dict[StageName, StageFigures]:
    """Figures of the finished stages by name; ``bounds`` are the histogram's, in seconds."""
    within = [func.sum(case((StageRow.seconds <= bound, 1), else_=0)) for bound in bounds]
    query = (
        select(
            StageRow.name,
            func.count().label("stages"),
            func.sum(StageRow.seconds).label("seconds"),
            func.sum(StageRow.cpu_seconds).label("cpu_seconds"),
            func.max(StageRow.peak_mb).label("peak_mb"),
            func.sum(StageRow.scans).label("scans"),
            func.sum(StageRow.points).label("points"),
            *within,
        )
        .where(StageRow.state == StageState.DONE, StageRow.cached.is_(False), StageRow.seconds.is_not(None))
        .group_by(StageRow.name)
    )
    return {
        row.name: StageFigures(
            row.stages,
            float(row.seconds),
            float(row.cpu_seconds or 0),
            float(row.peak_mb or 0),
            int(row.scans or 0),
            int(row.points or 0),
            tuple(int(count) for count in tuple(row)[7:]),
        )
        for row in session.execute(query)
    }


def step_seconds(session: Session) -> dict[str, tuple[int, float]]:
    """How often each step inside the stages ran, and its seconds in all."""
    query = select(StepRow.name, func.count(), func.sum(StepRow.seconds)).group_by(StepRow.name)
    return {name: (int(count), float(seconds)) for name, count, seconds in session.execute(query)}


def stage_states(session: Session) -> dict[tuple[StageName, StageState], int]:
    """Number of stages by name and state."""
    query = select(StageRow.name, StageRow.state, func.count()).group_by(StageRow.name, StageRow.state)
    return {(name, state): int(count) for name, state, count in session.execute(query)}


def job_states(session: Session) -> dict[JobState, int]:
    """Number of jobs by state, with a zero for states that none is in."""
    query = select(JobRow.state, func.count()).group_by(JobRow.state)
    return dict.fromkeys(JobState, 0) | {state: int(count) for state, count in session.execute(query)}


def training_states(session: Session) -> dict[JobState, int]:
    """Number of trainings by state, with a zero for states that none is in."""
    query = select(TrainingRow.state, func.count()).group_by(TrainingRow.state)
    return dict.fromkeys(JobState, 0) | {state: int(count) for state, count in session.execute(query)}


def oldest_queued(session: Session) -> dict[QueueName, datetime]:
    """Since when the stage that waits longest in each queue has been there."""
    query = select(StageRow.queue, func.min(StageRow.queued_at)).where(StageRow.state == StageState.QUEUED)
    return {queue: since for queue, since in session.execute(query.group_by(StageRow.queue)) if since is not None}


def recent_quality(session: Session, limit: int) -> list[JobRow]:
    """The most recent jobs that have figures of quality."""
    query = select(JobRow).where(JobRow.quality.is_not(None)).order_by(JobRow.id.desc()).limit(limit)
    return list(session.scalars(query))
