"""The memory of attempts: a row for each that ends, in the transaction that ends it."""

from __future__ import annotations

from dataclasses import dataclass, field

import structlog
from sqlalchemy import update

from l3ps_platform.catalog.attempt_rows import ESTIMATES, AttemptRow, ModelFiguresRow, Outcome
from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import DriveRow, JobRow, ModelRow, StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction

log = structlog.get_logger(__name__)

UNKNOWN = "unknown"
_FAILURES = (Outcome.FAILED, Outcome.RETRIED, Outcome.LOST)


@dataclass(frozen=True, slots=True)
class Cost:
    """What an attempt cost and how much it did.

    Attributes:
        seconds: wall time.
        cpu_seconds: processor time of the process, all threads.
        peak_mb: peak resident memory, MB.
        scans, points: what was processed.
        bytes: what an ingest took in and other stages stored.
        cached: the output was there already and nothing was computed.
        steps: (seconds, peak MB) of each step inside the stage.
    """

    seconds: float
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    scans: int = 0
    points: int = 0
    bytes: int = 0
    cached: bool = False
    steps: dict[str, tuple[float, float]] = field(default_factory=dict)


def note_end(
    tx: Transaction, stage: StageRow, outcome: Outcome, *, cost: Cost | None = None, error: Json | None = None
) -> None:
    """Remember an attempt that ends.

    Args:
        tx: the transaction that ends it.
        stage: as it was while the attempt ran: not yet read again after the change.
        outcome: how it ended; a failure of what is to be cancelled counts as cancelled.
        cost: what it cost; None where nobody is left to say.
        error: as the stage keeps it.
    """
    parent = _parent(tx, stage)
    if getattr(parent, "cancel_requested", False) and outcome in _FAILURES:
        outcome = Outcome.CANCELLED
    cause = str((error or {}).get("cause") or UNKNOWN)[:32] if outcome in _FAILURES else None
    started = stage.started_at or tx.now
    taken_in = parent.size if isinstance(parent, DriveRow | ModelRow) and outcome is Outcome.DONE else 0
    row = AttemptRow(
        project_id=parent.project_id,
        stage_id=stage.id,
        job_id=stage.job_id,
        name=stage.name,
        attempt=stage.attempt,
        owner=stage.lease_owner or "",
        started_at=started,
        finished_at=tx.now,
        outcome=outcome.value,
        cause=cause,
        seconds=cost.seconds if cost else max(0.0, (tx.now - started).total_seconds()),
        cpu_seconds=cost.cpu_seconds if cost else 0.0,
        peak_mb=cost.peak_mb if cost else 0.0,
        scans=cost.scans if cost else 0,
        points=cost.points if cost else 0,
        bytes=cost.bytes if cost and cost.bytes else taken_in,
        cached=cost.cached if cost else False,
    )
    tx.session.add(row)
    if cost is None and outcome in _FAILURES:  # else the worker that ran it says so
        log.warning("attempt lost", **ids(stage), owner=row.owner, cause=cause)


def note_again(tx: Transaction, stage: StageRow, outcome: Outcome) -> None:
    """Another attempt follows the one that this transaction noted as failed."""
    noted = (AttemptRow.stage_id == stage.id, AttemptRow.attempt == stage.attempt, AttemptRow.finished_at == tx.now)
    tx.session.execute(
        update(AttemptRow).where(*noted, AttemptRow.outcome == Outcome.FAILED.value).values(outcome=outcome.value)
    )


def note_figures(tx: Transaction, job: JobRow, quality: Json | None, estimates: Json | None) -> None:
    """Remember the figures of a job as the latest of its model.

    Args:
        tx: the transaction.
        job: the job; the caller holds its row.
        quality: against truth, where there was any.
        estimates: without truth.
    """
    for kind, figures in (((quality or {}).get("protocol"), quality), (ESTIMATES, estimates)):
        if kind and figures:
            row = ModelFiguresRow(project_id=job.project_id, model_id=job.model_id, kind=kind, job_id=job.id)
            row.figures, row.finished_at = figures, tx.now
            tx.session.merge(row)


def ids(stage: StageRow) -> dict[str, str | int]:
    """What names a stage in a line of the log."""
    named = {"job": stage.job_id, "scene": stage.scene_id, "drive": stage.drive_id, "model": stage.model_id}
    named |= {"training": stage.training_id, "stage": stage.id, "kind": stage.name.value}
    return {name: id for name, id in named.items() if id is not None} | {"attempt": stage.attempt}


def _parent(tx: Transaction, stage: StageRow) -> JobRow | TrainingRow | DriveRow | ModelRow:
    """Whom a stage belongs to; its row is in the session."""
    if stage.job_id is not None:
        return tx.session.get_one(JobRow, stage.job_id)
    if stage.training_id is not None:
        return tx.session.get_one(TrainingRow, stage.training_id)
    if stage.drive_id is not None:
        return tx.session.get_one(DriveRow, stage.drive_id)
    return tx.session.get_one(ModelRow, stage.model_id)
