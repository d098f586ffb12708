"""Sums over the catalog for the metrics.

What has happened is summed over the attempts, whose rows are only added: :func:`tallies` of a span of time, so that the
past need be read once only. What is the case now is counted by indexes, whatever the number of finished stages.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, case, func, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.attempt_rows import AttemptRow, ModelFiguresRow, Outcome
from l3ps_platform.catalog.event_rows import DeliveryRow
from l3ps_platform.catalog.models import JobRow, ModelRow, ProjectRow, StageRow, StepRow, TrainingRow, UploadRow
from l3ps_platform.catalog.states import (
    QUEUE_OF,
    DeliveryState,
    JobState,
    QueueName,
    StageName,
    StageState,
    UploadState,
)

BOUNDS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
"""Of the histogram of stages, in seconds. A scene of 40 keyframes refines in seconds to minutes; a drive is checked in
less than a second."""


@dataclass(frozen=True, slots=True)
class Kind:
    """Attempts that are counted together."""

    project_id: str
    stage: StageName
    outcome: Outcome
    cause: str | None
    cached: bool


@dataclass(frozen=True, slots=True)
class Tally:
    """Sums over attempts.

    Attributes:
        count: attempts.
        seconds, cpu_seconds: sums.
        peak_mb: the highest.
        scans, points, bytes: sums.
        within: for each of :data:`BOUNDS` the number of attempts that took at most so many seconds.
    """

    count: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    scans: int = 0
    points: int = 0
    bytes: int = 0
    within: tuple[int, ...] = (0,) * len(BOUNDS)

    def __add__(self, other: Tally) -> Tally:
        """Both together."""
        return Tally(
            self.count + other.count,
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(self.peak_mb, other.peak_mb),
            self.scans + other.scans,
            self.points + other.points,
            self.bytes + other.bytes,
            tuple(a + b for a, b in zip(self.within, other.within, strict=True)),
        )


def tallies(session: Session, since: datetime | None, before: datetime | None) -> dict[Kind, Tally]:
    """Sums over the attempts that ended in ``[since, before)``; None leaves that side open."""
    row = AttemptRow
    kind = (row.project_id, row.name, row.outcome, row.cause, row.cached)
    sums = [func.count(), func.sum(row.seconds), func.sum(row.cpu_seconds), func.max(row.peak_mb)]
    sums += [func.sum(row.scans), func.sum(row.points), func.sum(row.bytes)]
    within = [func.sum(case((row.seconds <= bound, 1), else_=0)) for bound in BOUNDS]
    query = select(*kind, *sums, *within).where(*_between(since, before)).group_by(*kind)
    found: dict[Kind, Tally] = {}
    rows: Iterable[Sequence[Any]] = session.execute(query)
    for found_row in rows:
        project_id, name, outcome, cause, cached = found_row[:5]
        count, seconds, cpu, peak, scans, points, size = found_row[5:12]
        found[Kind(project_id, name, Outcome(outcome), cause, cached)] = Tally(
            int(count),
            float(seconds),
            float(cpu),
            float(peak),
            int(scans),
            int(points),
            int(size),
            tuple(int(value) for value in found_row[12:]),
        )
    return found


def step_tallies(session: Session, since: datetime | None, before: datetime | None) -> dict[str, tuple[int, float]]:
    """How often each step ran inside the attempts that brought a result in ``[since, before)``, and its seconds."""
    query = (
        select(StepRow.name, func.count(), func.sum(StepRow.seconds))
        .join(AttemptRow, AttemptRow.stage_id == StepRow.stage_id)
        .where(AttemptRow.outcome == Outcome.DONE.value, *_between(since, before))
        .group_by(StepRow.name)
    )
    return {name: (int(count), float(seconds)) for name, count, seconds in session.execute(query)}


def open_stages(session: Session) -> dict[tuple[StageName, StageState], int]:
    """Number of stages that are not over, by name and state."""
    over = [state for state in StageState if not state.final]
    query = select(StageRow.name, StageRow.state, func.count()).where(StageRow.state.in_(over))
    rows = session.execute(query.group_by(StageRow.state, StageRow.name))
    return {(name, state): int(count) for name, state, count in rows}


def projects(session: Session) -> list[str]:
    """Ids of all projects."""
    return list(session.scalars(select(ProjectRow.id).order_by(ProjectRow.id)))


def job_states(session: Session, kind: type[JobRow] | type[TrainingRow]) -> dict[tuple[str, JobState], int]:
    """Number of jobs or trainings by project and state."""
    query = select(kind.project_id, kind.state, func.count()).group_by(kind.project_id, kind.state)
    return {(project_id, state): int(count) for project_id, state, count in session.execute(query)}


def upload_states(session: Session) -> dict[UploadState, int]:
    """Number of uploads by state."""
    query = select(UploadRow.state, func.count()).group_by(UploadRow.state)
    return dict.fromkeys(UploadState, 0) | {state: int(count) for state, count in session.execute(query)}


def delivery_states(session: Session) -> dict[DeliveryState, int]:
    """Number of messages to webhooks by state."""
    query = select(DeliveryRow.state, func.count()).group_by(DeliveryRow.state)
    return dict.fromkeys(DeliveryState, 0) | {state: int(count) for state, count in session.execute(query)}


def expired_leases(session: Session, now: datetime) -> int:
    """Running stages whose lease is over and which nobody has taken up yet."""
    query = select(func.count()).where(StageRow.state == StageState.RUNNING, StageRow.lease_until < now)
    return session.execute(query).scalar_one()


def oldest_queued(session: Session) -> dict[QueueName, datetime]:
    """Since when the stage that waits longest in each queue has been there."""
    query = select(StageRow.name, func.min(StageRow.queued_at)).where(StageRow.state == StageState.QUEUED)
    found: dict[QueueName, datetime] = {}
    for name, since in session.execute(query.group_by(StageRow.name)):
        if since is not None:
            queue = QUEUE_OF[name]
            found[queue] = min(since, found.get(queue, since))
    return found


def recent_quality(session: Session, limit: int) -> list[tuple[str, dict[str, Any]]]:
    """(job, quality) of the most recent jobs that have figures of quality."""
    query = select(JobRow.id, JobRow.quality).where(JobRow.quality.is_not(None))
    rows = session.execute(query.order_by(JobRow.id.desc()).limit(limit))
    return [(id, quality) for id, quality in rows if quality is not None]


def model_figures(session: Session, limit: int) -> list[tuple[ModelFiguresRow, str]]:
    """The figures of the models that were used last, each with its model's name."""
    query = select(ModelFiguresRow, ModelRow.name).join(ModelRow, ModelRow.id == ModelFiguresRow.model_id)
    rows = session.execute(query.order_by(ModelFiguresRow.finished_at.desc()).limit(limit))
    return [(row, name) for row, name in rows]


def _between(since: datetime | None, before: datetime | None) -> list[ColumnElement[bool]]:
    conditions = []
    if since is not None:
        conditions.append(AttemptRow.finished_at >= since)
    if before is not None:
        conditions.append(AttemptRow.finished_at < before)
    return conditions
