"""Is the job or the training finished, and how did it end?"""

from __future__ import annotations

from sqlalchemy import func, select, update

from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import JobRow, SceneRow, StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import JobState, StageName, StageState
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.planning import enqueue
from l3ps_platform.workflow.problems import MAX_PROBLEMS


def cancel_rest_of_scene(tx: Transaction, stage: StageRow, scene_state: StageState) -> None:
    """The scene of a failed or cancelled stage ends so; its later stages never begin."""
    if stage.scene_id is None:
        return
    scene = tx.session.get_one(SceneRow, stage.scene_id)
    scene.state = scene_state
    if scene_state is StageState.FAILED:
        notices.of_scene(tx, tx.session.get_one(JobRow, scene.job_id), scene, stage)
    tx.session.execute(
        update(StageRow)
        .where(StageRow.scene_id == stage.scene_id, StageRow.state.in_((StageState.WAITING, StageState.QUEUED)))
        .values(state=StageState.CANCELLED, finished_at=tx.now)
    )
    tx.session.flush()


def settle(tx: Transaction, parent: JobRow | TrainingRow) -> None:
    """:func:`settle_job` or :func:`settle_training`."""
    if isinstance(parent, JobRow):
        settle_job(tx, parent)
    else:
        settle_training(tx, parent)


def settle_job(tx: Transaction, job: JobRow) -> None:
    """Publish a job whose scenes are all final, and finish one whose publish stage is. The caller holds the job's row.

    A job with failed scenes still publishes the others, and then counts as failed: whoever reads only the state must
    not take half for the whole.
    """
    tx.session.flush()
    if job.state.final:
        return
    counts = _scene_counts(tx, job.id)
    publish = _publish_stage(tx, job.id)
    # With the manifest written the results are out: a cancel that comes then comes too late.
    if job.cancel_requested and not (publish is not None and publish.state is StageState.DONE):
        if not _running(tx, job.id):
            _finish(tx, job, JobState.CANCELLED)
        return
    if publish is None or any(not state.final for state in counts):
        return
    if publish.state is StageState.WAITING and publish.not_before is None:
        if counts.get(StageState.DONE):
            enqueue(tx, publish)
            return
        publish.state = StageState.CANCELLED
        publish.finished_at = tx.now
    if publish.state is StageState.DONE and not counts.get(StageState.FAILED):
        _finish(tx, job, JobState.SUCCEEDED)
    elif publish.state.final:
        job.error = _errors(tx, job.id, failed=counts.get(StageState.FAILED, 0), total=sum(counts.values()))
        _finish(tx, job, JobState.FAILED)


def settle_training(tx: Transaction, training: TrainingRow) -> None:
    """Finish a training whose stage is final. The caller holds the training's row."""
    tx.session.flush()
    query = select(StageRow).where(StageRow.training_id == training.id)
    stage = tx.session.scalars(query, execution_options={"populate_existing": True}).one()
    if training.state.final or not stage.state.final:
        return
    if stage.state is StageState.FAILED:
        training.error = stage.error
    _finish(tx, training, _ENDS[stage.state])


_ENDS = {
    StageState.DONE: JobState.SUCCEEDED,
    StageState.FAILED: JobState.FAILED,
    StageState.CANCELLED: JobState.CANCELLED,
}


def _finish(tx: Transaction, parent: JobRow | TrainingRow, state: JobState) -> None:
    parent.state = state
    parent.finished_at = tx.now
    tx.session.flush()
    notices.of_parent(tx, parent)


def _scene_counts(tx: Transaction, job_id: str) -> dict[StageState, int]:
    query = select(SceneRow.state, func.count()).where(SceneRow.job_id == job_id).group_by(SceneRow.state)
    return dict(tx.session.execute(query).all())


def _publish_stage(tx: Transaction, job_id: str) -> StageRow | None:
    query = select(StageRow).where(StageRow.job_id == job_id, StageRow.name == StageName.PUBLISH)
    return tx.session.scalars(query, execution_options={"populate_existing": True}).one_or_none()


def _running(tx: Transaction, job_id: str) -> bool:
    query = select(StageRow.id).where(StageRow.job_id == job_id, StageRow.state == StageState.RUNNING).limit(1)
    return tx.session.scalar(query) is not None


def _errors(tx: Transaction, job_id: str, *, failed: int, total: int) -> Json:
    """One sentence over all that failed, and the problems behind it."""
    query = (
        select(SceneRow.name, StageRow.name, StageRow.error)
        .outerjoin(SceneRow, SceneRow.id == StageRow.scene_id)
        .where(StageRow.job_id == job_id, StageRow.state == StageState.FAILED)
        .order_by(StageRow.id)
    )
    rows = tx.session.execute(query).all()
    reasons = [f"{scene or stage.value}: {(error or {}).get('message', 'no reason')}" for scene, stage, error in rows]
    problems = [problem for _, _, error in rows for problem in (error or {}).get("problems", [])]
    what = f"{failed} of {total} scenes failed" if failed else "the results could not be published"
    return {"message": f"{what}: {'; '.join(reasons[:3])}", "problems": problems[:MAX_PROBLEMS]}
