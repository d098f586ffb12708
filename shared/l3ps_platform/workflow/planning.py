"""From an accepted upload to a planned job: which rows there are and which stage goes first."""

from __future__ import annotations

from collections.abc import Sequence

from l3ps.errors import DriveLogError, InputError, ModelError, Problem
from l3ps_platform.catalog import bundles, drives
from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import DriveRow, JobRow, ModelRow, SceneRow, StageRow
from l3ps_platform.catalog.session import StageMessage, Transaction
from l3ps_platform.catalog.states import QUEUE_OF, DriveState, JobState, ModelState, StageName, StageState
from l3ps_platform.errors import NotFound
from l3ps_platform.ids import new_id
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.causes import cause_of, failure
from l3ps_platform.workflow.problems import MAX_PROBLEMS, problems_of


def accept_drive(
    tx: Transaction, *, name: str, filename: str, size: int, object_key: str, sha256: str | None = None
) -> DriveRow:
    """Record an uploaded archive and have it checked; ``sha256`` as the client claims it."""
    row = drives.add(tx, name=name, filename=filename, size=size, object_key=object_key, sha256=sha256)
    enqueue(tx, add_stage(tx, StageName.INGEST, drive_id=row.id))
    return row


def accept_source(tx: Transaction, *, source: str) -> DriveRow:
    """Record a log in somebody else's bucket, ``s3://bucket/prefix``, and have it fetched and checked."""
    name = source.rstrip("/").rpartition("/")[2][:200]
    row = drives.add(tx, name=name, filename=source, size=0, source=source)
    enqueue(tx, add_stage(tx, StageName.INGEST, drive_id=row.id))
    return row


def accept_model(
    tx: Transaction, *, name: str, filename: str, size: int, object_key: str, sha256: str | None = None
) -> ModelRow:
    """Record an uploaded bundle and have it checked. Conflict when the name is taken."""
    row = bundles.add(tx, name=name, filename=filename, size=size, object_key=object_key, sha256=sha256)
    enqueue(tx, add_stage(tx, StageName.INGEST, model_id=row.id))
    return row


def submit_job(
    tx: Transaction,
    *,
    drive_id: str,
    model: str,
    preset: str = "best",
    segment: str = "fast",
    formats: Sequence[str] = ("nuscenes",),
    protocol: str | None = None,
    skip_bad_scans: bool = False,
) -> JobRow:
    """A new job; it starts at once, or when its drive and model have been checked.

    Args:
        tx: the transaction.
        drive_id: the drive.
        model: the model's name or id.
        preset: name of a preset of the method.
        segment: name of a preset of the image segmentation.
        formats: label formats to write.
        protocol: evaluation protocol; None: the one that belongs to the log's truth.
        skip_bad_scans: go on with the good scans of a log with some bad ones.

    Raises:
        NotFound: no such drive or model.
        DriveLogError: the drive was rejected, or has bad scans and they are not to be skipped.
        ModelError: the model was rejected, or has no graph for the segmentation asked for.
    """
    drive = drives.lock(tx.session, drive_id)
    if drive.deleted_at is not None:
        raise NotFound("drive", drive_id)
    bundle = bundles.lock(tx.session, bundles.by_name(tx.session, model).id)
    if bundle.deleted_at is not None:
        raise NotFound("model", model)
    job = JobRow(
        id=new_id("job"),
        drive_id=drive.id,
        model_id=bundle.id,
        settings={
            "preset": preset,
            "segment": segment,
            "formats": list(formats),
            "protocol": protocol,
            "skip_bad_scans": skip_bad_scans,
        },
        state=JobState.QUEUED,
        cancel_requested=False,
        created_at=tx.now,
    )
    refusal = _refusal(drive, bundle, job)
    if refusal is not None:
        raise refusal
    tx.session.add(job)
    tx.session.flush()
    notices.of_parent(tx, job)
    plan_if_ready(tx, job, drive, bundle)
    return job


def plan_if_ready(tx: Transaction, job: JobRow, drive: DriveRow, model: ModelRow) -> None:
    """Make the scenes and stages of a queued job once its drive and model are ready; fail it if they cannot be used.

    The caller holds the drive's and the model's row.
    """
    refusal = _refusal(drive, model, job)
    if refusal is not None:
        job.state = JobState.FAILED
        job.error = error_json(refusal)
        job.finished_at = tx.now
        notices.of_parent(tx, job)
        return
    if drive.state is not DriveState.READY or model.state is not ModelState.READY:
        return
    info = drive.info or {}
    if job.settings.get("protocol") is None:
        truth_space = info.get("truth_space")
        job.settings = {**job.settings, "protocol": "semantickitti" if truth_space == "semantickitti" else "nuscenes"}
    for position, scene in enumerate(info.get("scenes", [])):
        row = SceneRow(
            id=new_id("scn"),
            job_id=job.id,
            name=scene["name"],
            position=position,
            scans=scene["scans"],
            points=scene["points"],
            state=StageState.QUEUED,
        )
        tx.session.add(row)
        tx.session.flush()
        enqueue(tx, add_stage(tx, StageName.SEGMENT, job_id=job.id, scene_id=row.id))
        add_stage(tx, StageName.REFINE, job_id=job.id, scene_id=row.id)
    add_stage(tx, StageName.PUBLISH, job_id=job.id)


def add_stage(tx: Transaction, name: StageName, **owner: str) -> StageRow:
    """A stage that waits; ``owner`` names its job, scene, drive or model."""
    row = StageRow(id=new_id("stg"), name=name, queue=QUEUE_OF[name], state=StageState.WAITING, attempt=1, **owner)
    row.progress_done = row.progress_total = 0
    row.fraction = 0.0
    row.cached = False
    row.failures = 0
    tx.session.add(row)
    tx.session.flush()
    return row


def enqueue(tx: Transaction, stage: StageRow) -> None:
    """Mark a stage queued; its message leaves after the commit."""
    stage.state = StageState.QUEUED
    stage.queued_at = tx.now
    stage.not_before = None
    tx.session.flush()
    tx.outbox.append(StageMessage(stage.id, stage.attempt, stage.name, stage.queue))


def error_json(error: BaseException) -> Json:
    """An error as rows keep it: its sentence, its cause and, for bad input, its first problems."""
    problems = [p.as_dict() for p in error.problems[:MAX_PROBLEMS]] if isinstance(error, InputError) else []
    return failure(str(error) or type(error).__name__, cause_of(error)) | {"problems": problems}


def _refusal(drive: DriveRow, model: ModelRow, job: JobRow) -> InputError | None:
    problems = problems_of(drive.problem)
    if drive.state is DriveState.REJECTED and problems:
        return DriveLogError(problems)
    spoilt = [problem for problem in problems if problem.severity != "warning"]
    if drive.state is DriveState.READY and spoilt and not job.settings["skip_bad_scans"]:
        return DriveLogError(spoilt)
    if model.state is ModelState.REJECTED:
        return ModelError(problems_of(model.problem))
    passes = (model.info or {}).get("passes", [])
    if model.state is ModelState.READY and job.settings.get("segment") == "balanced" and "balanced" not in passes:
        what, remedy = "it has no graph for the preset 'balanced'", "Choose segment fast, or export one with it."
        return ModelError(Problem("missing-pass", f"model '{model.name}'", what, remedy))
    info = drive.info or {}
    if info.get("has_truth") and job.settings["protocol"] == "semantickitti" != info.get("truth_space"):
        what = f"the log's truth is in {info.get('truth_space')} classes, which semantickitti cannot score"
        return InputError(Problem("protocol-mismatch", "protocol", what, "Choose protocol nuscenes or paper."))
    return None
