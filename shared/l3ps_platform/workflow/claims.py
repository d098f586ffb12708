"""Who owns a stage: a conditional UPDATE decides, a lease bounds it, a heartbeat prolongs it.

The queue may deliver a message twice, late or never; none of that matters here. Every change of a stage names the
attempt and the owner it believes in and does nothing when the row disagrees.

Rows are locked in one order everywhere: annotations, drive, model, job or training, stage.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import CursorResult, Update, and_, or_, select, update

from l3ps.errors import Cancelled
from l3ps_platform.catalog import bundles, drives, jobs, stages, trainings
from l3ps_platform.catalog.models import JobRow, SceneRow, StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import DriveState, JobState, ModelState, StageName, StageState
from l3ps_platform.errors import LeaseLost, NotFound
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.causes import Cause, failure

LOST = failure("the worker that ran this stage stopped answering", Cause.LEASE_LOST)


@dataclass(frozen=True, slots=True)
class Claim:
    """A stage in this worker's hands.

    Attributes:
        stage_id: the stage.
        attempt: which attempt at it this is, from 1.
        owner: who holds it.
        name: what to do.
        lease_seconds: how long the lease runs from each sign of life.
        job_id, scene_id, drive_id, model_id, training_id: whom the stage belongs to.
    """

    stage_id: str
    attempt: int
    owner: str
    name: StageName
    lease_seconds: float
    job_id: str | None = None
    scene_id: str | None = None
    drive_id: str | None = None
    model_id: str | None = None
    training_id: str | None = None


def claim(tx: Transaction, stage_id: str, attempt: int, owner: str, *, lease_seconds: float) -> Claim | None:
    """Take a stage, or None when it is not to be had: taken, finished, cancelled, or the message is an old one.

    An owner may claim again what it already holds: it works on one stage at a time, and so learns whether a claim was
    committed whose answer was lost. What another one holds is not taken over, its lease run out or not: the reconciler
    ends such an attempt, counts it and sends the next.
    """
    stage = tx.session.get(StageRow, stage_id)
    if stage is None:
        return None
    parent = lock_parents(tx, stage)
    mine = stage.state is StageState.RUNNING and stage.lease_owner == owner
    if parent is not None and (parent.cancel_requested or parent.state.final) and not mine:
        return None
    lease = {
        "state": StageState.RUNNING,
        "lease_owner": owner,
        "lease_until": tx.now + timedelta(seconds=lease_seconds),
        "started_at": tx.now,
        "progress_step": None,
        "progress_done": 0,
        "progress_total": 0,
        "fraction": 0.0,
    }
    held = and_(StageRow.state == StageState.RUNNING, StageRow.lease_owner == owner)
    free = (StageRow.id == stage_id, StageRow.attempt == attempt, or_(StageRow.state == StageState.QUEUED, held))
    if not changed(tx, update(StageRow).where(*free).values(**lease)):
        return None
    _mark_parents_running(tx, stage, parent)
    return Claim(
        stage_id,
        attempt,
        owner,
        stage.name,
        lease_seconds,
        job_id=stage.job_id,
        scene_id=stage.scene_id,
        drive_id=stage.drive_id,
        model_id=stage.model_id,
        training_id=stage.training_id,
    )


def prolong(tx: Transaction, owner_prefix: str, lives: Callable[[str], bool], lease_seconds: float) -> int:
    """Prolong the leases that living owners hold.

    Args:
        tx: the transaction.
        owner_prefix: only of owners whose name begins so.
        lives: whether the owner of this name lives.
        lease_seconds: how long the leases run from now.

    Returns:
        How many leases were prolonged.
    """
    count = 0
    for stage_id, owner in stages.owned(tx.session, owner_prefix):
        if lives(owner):
            held = (StageRow.id == stage_id, StageRow.lease_owner == owner, StageRow.state == StageState.RUNNING)
            until = tx.now + timedelta(seconds=lease_seconds)
            count += changed(tx, update(StageRow).where(*held).values(lease_until=until))
    return count


def report(tx: Transaction, claim: Claim, step: str, done: int, total: int, *, fraction: float) -> None:
    """Record progress and prolong the lease.

    Args:
        tx: the transaction.
        claim: the stage.
        step: what the method is doing.
        done, total: units of that step.
        fraction: 0..1, over all steps of the stage.

    Raises:
        LeaseLost: the stage is no longer ours.
        Cancelled: the job or training was cancelled.
    """
    progress = {"progress_step": step[:32], "progress_done": done, "progress_total": total, "fraction": fraction}
    if not changed(tx, update(StageRow).where(*owned(claim)).values(lease_until=_until(tx, claim), **progress)):
        raise LeaseLost(f"stage {claim.stage_id} attempt {claim.attempt} now belongs to another worker")
    check_cancelled(tx, claim)


def check_cancelled(tx: Transaction, claim: Claim) -> None:
    """Raise Cancelled when the claim's job or training is to stop."""
    job = select(JobRow.cancel_requested).where(JobRow.id == claim.job_id)
    if claim.job_id is not None and tx.session.scalar(job):
        raise Cancelled(f"job {claim.job_id} was cancelled")
    training = select(TrainingRow.cancel_requested).where(TrainingRow.id == claim.training_id)
    if claim.training_id is not None and tx.session.scalar(training):
        raise Cancelled(f"training {claim.training_id} was cancelled")


def owned(claim: Claim) -> tuple[Any, ...]:
    """The conditions under which a stage is this claim's."""
    return (
        StageRow.id == claim.stage_id,
        StageRow.attempt == claim.attempt,
        StageRow.lease_owner == claim.owner,
        StageRow.state == StageState.RUNNING,
    )


def changed(tx: Transaction, statement: Update) -> bool:
    """Run a conditional UPDATE; whether it changed a row."""
    options = {"synchronize_session": False}
    result = cast("CursorResult[Any]", tx.session.execute(statement, execution_options=options))
    return result.rowcount > 0


def lock_parents(tx: Transaction, stage: StageRow) -> JobRow | TrainingRow | None:
    """Hold the rows that a stage's change of state may touch, always in the same order; its job or training, if any."""
    if stage.drive_id is not None:
        drives.lock(tx.session, stage.drive_id)
    if stage.model_id is not None:
        bundles.lock(tx.session, stage.model_id)
    with suppress(NotFound):
        if stage.job_id is not None:
            return jobs.lock(tx.session, stage.job_id)
        if stage.training_id is not None:
            return trainings.lock(tx.session, stage.training_id)
    return None


def _until(tx: Transaction, claim: Claim) -> datetime:
    return tx.now + timedelta(seconds=claim.lease_seconds)


def _mark_parents_running(tx: Transaction, stage: StageRow, parent: JobRow | TrainingRow | None) -> None:
    if parent is not None and parent.state is JobState.QUEUED:
        parent.state = JobState.RUNNING
        parent.started_at = tx.now
        notices.of_parent(tx, parent)
    if stage.scene_id is not None:
        scene = tx.session.get(SceneRow, stage.scene_id)
        if scene is not None:
            scene.state = StageState.RUNNING
    if stage.drive_id is not None:
        drives.lock(tx.session, stage.drive_id).state = DriveState.VALIDATING
    if stage.model_id is not None:
        bundles.lock(tx.session, stage.model_id).state = ModelState.VALIDATING
    tx.session.flush()
    tx.session.refresh(stage)
