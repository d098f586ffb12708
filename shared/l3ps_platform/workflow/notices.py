"""What the event log says of each change of state.

Each is called where the state changes, after it has: one line there, and here what clients are told.
"""

from __future__ import annotations

from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.kinds import EventKind
from l3ps_platform.catalog.models import DriveRow, JobRow, ModelRow, SceneRow, StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.workflow.problems import problem_count


def of_parent(tx: Transaction, parent: JobRow | TrainingRow) -> None:
    """A job or training has come to the state that its row shows."""
    names: Json
    if isinstance(parent, JobRow):
        thing, names = "job", {"drive_id": parent.drive_id, "model_id": parent.model_id}
    else:
        thing, names = "training", {"name": parent.name, "model_id": parent.model_id}
    message = (parent.error or {}).get("message")
    data: Json = {"id": parent.id, "state": parent.state.value, **names, "message": message}
    tx.emit(EventKind(f"{thing}.{parent.state}"), parent, _known(data))


def of_upload(tx: Transaction, row: DriveRow | ModelRow) -> None:
    """A drive or model was checked."""
    thing = "drive" if isinstance(row, DriveRow) else "model"
    problems = (row.problem or {}).get("problems", [])
    first = f"{problems[0].get('where')}: {problems[0].get('what')}" if problems else None
    count = problem_count(row.problem)
    data: Json = {"id": row.id, "state": row.state.value, "name": row.name, "problems": count, "message": first}
    tx.emit(EventKind(f"{thing}.{row.state}"), row, _known(data))


def of_scene(tx: Transaction, job: JobRow, scene: SceneRow, stage: StageRow) -> None:
    """A scene of a job is done or has failed, with the stage that ended it."""
    message = (stage.error or {}).get("message")
    data: Json = {"job_id": job.id, "scene_id": scene.id, "name": scene.name, "position": scene.position}
    tx.emit(EventKind(f"scene.{scene.state}"), job, _known({**data, "state": scene.state.value, "message": message}))


def of_retry(tx: Transaction, parent: JobRow | TrainingRow | None, stage: StageRow) -> None:
    """An attempt at a stage failed and there will be another one; told with the job or training, if it has one."""
    if parent is None:
        return  # the check of an upload: what comes of it is told
    owner = "job_id" if isinstance(parent, JobRow) else "training_id"
    data: Json = {owner: parent.id, "scene_id": stage.scene_id, "stage_id": stage.id, "stage": stage.name.value}
    message = (stage.error or {}).get("message")
    tx.emit(EventKind.STAGE_RETRIED, parent, _known({**data, "attempt": stage.attempt, "message": message}))


def _known(data: Json) -> Json:
    return {name: value for name, value in data.items() if value is not None}
