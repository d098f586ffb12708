"""What a stage's end means for its scene, its job, its training or its drive."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from sqlalchemy import delete, update

from l3ps.errors import Problem
from l3ps_platform.catalog import bundles, drives, jobs, stages
from l3ps_platform.catalog.attempt_rows import Outcome
from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import JobRow, SceneRow, StageRow, StepRow
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.catalog.states import DriveState, ModelState, StageName, StageState
from l3ps_platform.errors import LeaseLost
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.attempts import Cost, note_again, note_end, note_figures
from l3ps_platform.workflow.causes import Cause, failure
from l3ps_platform.workflow.claims import Claim, changed, lock_parents, owned
from l3ps_platform.workflow.planning import enqueue, plan_if_ready
from l3ps_platform.workflow.problems import kept_problems
from l3ps_platform.workflow.retries import Retry, next_try
from l3ps_platform.workflow.settling import cancel_rest_of_scene, settle, settle_job


def complete(
    tx: Transaction,
    claim: Claim,
    cost: Cost,
    *,
    output_key: str | None = None,
    quality: Json | None = None,
    estimates: Json | None = None,
) -> None:
    """A segment, refine or publish stage is done: record it and enqueue what follows.

    Args:
        tx: the transaction.
        claim: the stage.
        cost: what it cost.
        output_key: where its output lies.
        quality: for a refine stage the scene's, for a publish stage the job's.
        estimates: for a publish stage what can be told of the job's labels without truth.

    Raises:
        LeaseLost: the stage is no longer ours; nothing was changed.
    """
    stage = finish(tx, claim, StageState.DONE, cost=cost, output_key=output_key)
    job = jobs.lock(tx.session, _must(stage.job_id))
    if stage.name is StageName.PUBLISH:
        job.quality = quality
        note_figures(tx, job, quality, estimates)
    elif stage.scene_id is not None:
        scene = tx.session.get_one(SceneRow, stage.scene_id)
        if quality is not None:
            scene.quality = quality
        rest = [other for other in stages.of_scene(tx.session, scene.id) if other.state is not StageState.DONE]
        if not rest:
            scene.state = StageState.DONE
            notices.of_scene(tx, job, scene, stage)
        elif job.cancel_requested:
            scene.state = StageState.CANCELLED
        elif rest[0].state is StageState.WAITING:
            enqueue(tx, rest[0])
    settle_job(tx, job)


def drive_checked(
    tx: Transaction,
    claim: Claim,
    cost: Cost,
    *,
    usable: bool,
    problems: Sequence[Problem],
    sha256: str | None = None,
    size: int | None = None,
    format: str | None = None,
    info: Json | None = None,
) -> None:
    """A drive's ingest is done: it is ready or rejected, and jobs that waited for it begin or fail. LeaseLost."""
    stage = finish(tx, claim, StageState.DONE, cost=cost, error=None if usable else _rejection(problems))
    drive = drives.lock(tx.session, _must(stage.drive_id))
    drive.state = DriveState.READY if usable else DriveState.REJECTED
    drive.problem = kept_problems(problems)
    drive.sha256, drive.format, drive.info = sha256, format, info
    drive.size = drive.size if size is None else size
    tx.session.flush()
    notices.of_upload(tx, drive)
    _plan_waiting(tx, drive_id=drive.id)


def model_checked(
    tx: Transaction,
    claim: Claim,
    cost: Cost,
    *,
    problems: Sequence[Problem],
    sha256: str | None = None,
    info: Json | None = None,
) -> None:
    """A model's ingest is done: it is rejected if there are problems, else ready. LeaseLost."""
    stage = finish(tx, claim, StageState.DONE, cost=cost, error=_rejection(problems) if problems else None)
    model = bundles.lock(tx.session, _must(stage.model_id))
    model.state = ModelState.REJECTED if problems else ModelState.READY
    model.problem = kept_problems(problems)
    model.sha256, model.info = sha256, info
    tx.session.flush()
    notices.of_upload(tx, model)
    _plan_waiting(tx, model_id=model.id)


def fail(tx: Transaction, claim: Claim, error: Json, *, retry: Retry | None = None, cost: Cost | None = None) -> None:
    """An attempt failed: it is tried again later if ``retry`` and the cause allow, else the stage has failed.

    A failed scene does not stop the others of its job. LeaseLost when the stage is no longer ours.

    Args:
        tx: the transaction.
        claim: the stage.
        error: ``{"message", "problems", "cause"}``; without a cause it counts as one of the stage's own.
        retry: how often and how long it may be tried; None for not again.
        cost: what it cost.
    """
    failed(tx, finish(tx, claim, StageState.FAILED, cost=cost, error=error), retry)


def failed(tx: Transaction, stage: StageRow, retry: Retry | None, again: Outcome = Outcome.RETRIED) -> None:
    """The consequences of a failed attempt whose row says so already, with its error.

    Args:
        tx: the transaction.
        stage: the stage.
        retry: how often and how long it may be tried; None for not again.
        again: what the attempt is remembered as if another one follows.
    """
    parent = lock_parents(tx, stage)
    if parent is not None and parent.cancel_requested:
        stage.state, stage.error = StageState.CANCELLED, failure(_WAS_CANCELLED, Cause.CANCELLED)
        cancel_rest_of_scene(tx, stage, StageState.CANCELLED)
        settle(tx, parent)
    elif retry is not None and (moment := next_try(tx, stage, retry)) is not None:
        note_again(tx, stage, again)
        stage.state, stage.not_before, stage.finished_at = StageState.WAITING, moment, None
        stage.attempt += 1
        tx.session.flush()
        notices.of_retry(tx, parent, stage)
    elif parent is not None:
        cancel_rest_of_scene(tx, stage, StageState.FAILED)
        settle(tx, parent)
    else:
        _reject_unchecked(tx, stage)


def cancelled(tx: Transaction, claim: Claim, cost: Cost | None = None) -> None:
    """The worker saw the cancel flag and stopped. LeaseLost when the stage is no longer ours."""
    stage = finish(tx, claim, StageState.CANCELLED, cost=cost, error=failure(_WAS_CANCELLED, Cause.CANCELLED))
    cancel_rest_of_scene(tx, stage, StageState.CANCELLED)
    parent = lock_parents(tx, stage)
    if parent is not None:
        settle(tx, parent)


def release(tx: Transaction, claim: Claim) -> None:
    """Give a stage back because this worker stops: it is queued again and no attempt is counted. LeaseLost."""
    stage = finish(tx, claim, StageState.QUEUED)
    parent = lock_parents(tx, stage)
    if parent is not None and parent.cancel_requested:
        failed(tx, stage, None)
    else:
        enqueue(tx, stage)


def release_owned(catalog: Catalog, owner_prefix: str) -> int:
    """Give back every stage whose owner's name begins so; how many. For a worker that was made to stop in mid-stage.

    One transaction for each: workers that stop together hold stages of the same jobs, each in an order of its own.
    """
    with catalog.reading() as session:
        held = stages.owned(session, owner_prefix)
    count = 0
    for stage_id, owner in held:
        with suppress(LeaseLost), catalog.transaction() as tx:
            stage = stages.get(tx.session, stage_id)
            release(tx, Claim(stage_id, stage.attempt, owner, stage.name, 0.0))
            count += 1
    return count


def cancel_job(tx: Transaction, job_id: str) -> JobRow:
    """Stop a job: what has not begun never will, what runs stops at its next scan. A finished job stays as it is.

    NotFound when there is no such job.
    """
    job = jobs.lock(tx.session, job_id)
    if job.state.final:
        return job
    job.cancel_requested = True
    idle = (StageState.WAITING, StageState.QUEUED)
    for stage in stages.of_job(tx.session, job_id):
        stop = update(StageRow).where(StageRow.id == stage.id, StageRow.state.in_(idle))
        if changed(tx, stop.values(state=StageState.CANCELLED, finished_at=tx.now)):
            tx.session.refresh(stage)
    running = {s.scene_id for s in stages.of_job(tx.session, job_id) if s.state is StageState.RUNNING}
    for scene in jobs.scenes(tx.session, job_id):
        if not scene.state.final and scene.id not in running:
            scene.state = StageState.CANCELLED
    settle_job(tx, job)
    return job


def finish(
    tx: Transaction,
    claim: Claim,
    state: StageState,
    *,
    cost: Cost | None = None,
    output_key: str | None = None,
    error: Json | None = None,
) -> StageRow:
    """Mark a stage that is the claim's, and note its cost; the consequences are the caller's. LeaseLost."""
    stage = tx.session.get(StageRow, claim.stage_id)
    if stage is None:
        raise LeaseLost(f"stage {claim.stage_id} is gone")
    lock_parents(tx, stage)
    values: dict[str, object] = {"state": state, "lease_owner": None, "lease_until": None, "error": error}
    values |= {"output_key": output_key, "finished_at": tx.now if state.final else None}
    if cost is not None:
        values |= {"seconds": cost.seconds, "cpu_seconds": cost.cpu_seconds, "peak_mb": cost.peak_mb}
        values |= {"scans": cost.scans, "points": cost.points, "cached": cost.cached}
    if state is StageState.DONE:
        values["fraction"] = 1.0
    if not changed(tx, update(StageRow).where(*owned(claim)).values(**values)):
        raise LeaseLost(f"stage {claim.stage_id} attempt {claim.attempt} now belongs to another worker")
    note_end(tx, stage, _OUTCOMES[state], cost=cost, error=error)
    if cost is not None:
        tx.session.execute(delete(StepRow).where(StepRow.stage_id == claim.stage_id))
        for name, (seconds, peak_mb) in cost.steps.items():
            tx.session.add(StepRow(stage_id=claim.stage_id, name=name[:32], seconds=seconds, peak_mb=peak_mb))
    tx.session.flush()
    tx.session.refresh(stage)
    return stage


_OUTCOMES = {
    StageState.DONE: Outcome.DONE,
    StageState.FAILED: Outcome.FAILED,
    StageState.QUEUED: Outcome.RELEASED,
    StageState.CANCELLED: Outcome.CANCELLED,
}
"""What the end of an attempt is called that left its stage in this state."""


def _rejection(problems: Sequence[Problem]) -> Json:
    """What the stage of an upload that was refused says: the check itself did its work."""
    why = f": {problems[0]}" if problems else ""
    return failure(f"the check is done and the upload is rejected{why}", Cause.BAD_INPUT)


def _plan_waiting(tx: Transaction, *, drive_id: str | None = None, model_id: str | None = None) -> None:
    for job in jobs.unplanned(tx.session, drive_id=drive_id, model_id=model_id):
        drive = drives.get(tx.session, job.drive_id) if drive_id is None else drives.lock(tx.session, drive_id)
        model = bundles.get(tx.session, job.model_id)
        plan_if_ready(tx, job, drive, model)
    tx.session.flush()


def _reject_unchecked(tx: Transaction, stage: StageRow) -> None:
    """An upload that could not be checked is no use to anyone: reject it and say why."""
    problem = Problem(
        code="not-checked",
        where="upload",
        what=f"it could not be checked: {(stage.error or {}).get('message', 'unknown error')}",
        remedy="Upload it again; if that does not help, ask whoever runs the service.",
    )
    kept = kept_problems([problem])
    if stage.drive_id is not None:
        drive = drives.lock(tx.session, stage.drive_id)
        drive.state, drive.problem = DriveState.REJECTED, kept
        notices.of_upload(tx, drive)
    if stage.model_id is not None:
        model = bundles.lock(tx.session, stage.model_id)
        model.state, model.problem = ModelState.REJECTED, kept
        notices.of_upload(tx, model)
    tx.session.flush()
    _plan_waiting(tx, drive_id=stage.drive_id, model_id=stage.model_id)


_WAS_CANCELLED = "it was stopped because its job was cancelled"


def _must(id: str | None) -> str:
    if id is None:
        raise ValueError("the stage has no such parent")
    return id
