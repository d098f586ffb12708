"""Start again what failed or was cancelled; what is done stays done."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence

from sqlalchemy.orm import Session

from l3ps_platform.catalog import annotation_sets, bundles, drives, jobs, stages, trainings
from l3ps_platform.catalog.models import JobRow, SceneRow, StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import JobState, ModelState, StageName, StageState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.planning import enqueue, plan_if_ready
from l3ps_platform.workflow.settling import settle_job

_AGAIN = (JobState.FAILED, JobState.CANCELLED)


def outputs_to_keep(session: Session, job_id: str) -> list[str]:
    """Keys of the outputs that another run of a job goes on from, and that may be gone. NotFound.

    Only of what was read and then failed: its reader may have failed for want of it. Others are taken to be there; a
    stage that does not find its input fails, and the next retry looks.
    """
    if jobs.get(session, job_id).state not in _AGAIN:
        return []
    planned = stages.of_job(session, job_id)
    of_scenes: defaultdict[str, list[StageRow]] = defaultdict(list)
    for stage in planned:
        if stage.scene_id is not None:
            of_scenes[stage.scene_id].append(stage)
    publication = [stage for stage in planned if stage.scene_id is None]
    keys = []
    for own in of_scenes.values():
        last = _last_done(own)
        readers = [] if last is None else [*own[own.index(last) + 1 :], *publication]
        if last is not None and last.output_key is not None and readers[0].state is StageState.FAILED:
            keys.append(last.output_key)
    return keys


def retry_job(tx: Transaction, job_id: str, gone: Collection[str] = ()) -> JobRow:
    """Run a failed or cancelled job again: only the stages that are not done, or whose output is gone.

    Attempt numbers go on rising, so that no message of before fits.

    Args:
        tx: the transaction.
        job_id: the job.
        gone: which of :func:`outputs_to_keep` are no longer in the store.

    Raises:
        NotFound: no such job.
        Conflict: the job has succeeded or is not over, or its drive was deleted.
        InputError: its drive or model was rejected.
    """
    job = jobs.get(tx.session, job_id)
    drive = drives.lock(tx.session, job.drive_id)
    model = bundles.lock(tx.session, job.model_id)
    job = jobs.lock(tx.session, job_id)
    if job.deleted_at is not None:
        raise NotFound("job", job_id)
    if job.state not in _AGAIN:
        raise Conflict(f"job {job_id} is {job.state}: only a failed or cancelled job can be run again")
    if drive.deleted_at is not None:
        raise Conflict(f"drive {drive.id} was deleted: upload it again and submit a new job")
    if model.deleted_at is not None:
        raise Conflict(f"model {model.name!r} is gone: submit a new job with another one")
    job.state, job.cancel_requested, job.error, job.quality = JobState.QUEUED, False, None, None
    job.started_at = job.finished_at = None
    tx.session.flush()
    notices.of_parent(tx, job)
    planned = stages.of_job(tx.session, job_id)
    if not planned:
        plan_if_ready(tx, job, drive, model)
        return job
    for scene in jobs.scenes(tx.session, job_id):
        _retry_scene(tx, scene, [stage for stage in planned if stage.scene_id == scene.id], gone)
    _reset(tx, next(stage for stage in planned if stage.name is StageName.PUBLISH))
    settle_job(tx, job)
    return job


def retry_training(tx: Transaction, training_id: str) -> TrainingRow:
    """Run a failed or cancelled training again, from its last checkpoint where there is one.

    Raises:
        NotFound: no such training.
        Conflict: it has succeeded or is not over, its name was taken meanwhile, or its annotations are gone.
    """
    training = trainings.get(tx.session, training_id)
    gone = _hold_annotations(tx, training)
    holder = bundles.named(tx.session, training.name, training.project_id)
    training = trainings.lock(tx.session, training_id)
    if training.state not in _AGAIN:
        raise Conflict(f"training {training_id} is {training.state}: only a failed or cancelled one can be run again")
    if holder is not None and holder.state is not ModelState.REJECTED:
        raise Conflict(f"there is a model named {training.name!r} meanwhile: start it under another name")
    under_way = trainings.unfinished(tx.session, training.name)
    if under_way is not None:
        raise Conflict(f"training {under_way.id} is to become model {training.name!r}: wait for it, or cancel it")
    if gone is not None:
        raise Conflict(f"the archive of annotations {gone} is gone: upload it again and start a new training")
    training.state, training.cancel_requested, training.error = JobState.QUEUED, False, None
    training.started_at = training.finished_at = None
    notices.of_parent(tx, training)
    stage = stages.of_training(tx.session, training_id)
    _reset(tx, stage)
    enqueue(tx, stage)
    return training


def _hold_annotations(tx: Transaction, training: TrainingRow) -> str | None:
    """Hold what a training learns from, before its model's name, as who starts one does; the first that is gone."""
    for id in sorted({training.annotations_id, training.validation_id or training.annotations_id}):
        try:
            if annotation_sets.lock(tx.session, id).object_key is None:
                return id
        except NotFound:
            return id
    return None


def _last_done(own: Sequence[StageRow]) -> StageRow | None:
    """A scene's last stage that is done: the only one whose output what follows reads."""
    return next((stage for stage in reversed(own) if stage.state is StageState.DONE), None)


def _retry_scene(tx: Transaction, scene: SceneRow, own: list[StageRow], gone: Collection[str]) -> None:
    """Begin behind the last stage that is done, or at the first where its output is gone."""
    last = _last_done(own)
    again = own[own.index(last) + 1 :] if last is not None and last.output_key not in gone else own
    if not again:
        return
    scene.state = StageState.QUEUED
    for stage in again:
        _reset(tx, stage)
    enqueue(tx, again[0])


def _reset(tx: Transaction, stage: StageRow) -> None:
    """A stage as when it was planned, but for the number of its attempt."""
    stage.state = StageState.WAITING
    stage.attempt += 1
    stage.failures = stage.losses = 0
    stage.outage_seconds = 0.0
    stage.not_before = stage.finished_at = stage.started_at = None
    stage.error = stage.output_key = stage.progress_step = None
    stage.progress_done = stage.progress_total = 0
    stage.fraction = 0.0
    stage.cached = False
    tx.session.flush()
