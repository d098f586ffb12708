"""The tables. The catalog is the truth about jobs; the queue only carries (stage id, attempt)."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey, Index, String, UniqueConstraint, text
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Json, Owned
from l3ps_platform.catalog.states import (
    DriveState,
    JobState,
    ModelState,
    QueueName,
    StageName,
    StageState,
    UploadState,
)

DEFAULT_PROJECT = "prj_default"
"""The project that is there from the start."""


class ProjectRow(Base):
    """A team's drives, models, jobs and labels; other projects see nothing of them."""

    __tablename__ = "projects"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200), unique=True)
    created_at: Mapped[datetime]
    deleted_at: Mapped[datetime | None]


class UploadRow(Owned, Base):
    """A multipart upload in progress, or its memory."""

    __tablename__ = "uploads"
    noun = "upload"
    __table_args__ = (Index(None, "state", "expires_at"), Index(None, "project_id", "id"))

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))  # drive | model | annotations
    filename: Mapped[str]
    size: Mapped[int]
    sha256: Mapped[str | None] = mapped_column(String(64))  # the client's claim
    parts: Mapped[int]
    part_size: Mapped[int]  # of every part but the last; 0 in rows of before this was kept
    state: Mapped[UploadState] = mapped_column(default=UploadState.OPEN)
    object_key: Mapped[str]
    s3_upload_id: Mapped[str]
    result_id: Mapped[str | None] = mapped_column(String(32))  # the drive, model or annotations it became
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]


class DriveRow(Owned, Base):
    """A drive log.

    ``problem`` is ``{"problems": [Problem.as_dict()…], "count"}``, the first of very many
    (l3ps_platform.workflow.problems); a ready drive may carry one too: scans that a job can skip.
    ``info`` once ready: ``{"scenes": [{"name", "scans", "points"}…], "scans", "points", "has_truth", "truth_space"}``,
    counts over the scans a job will label. ``object_key`` is None once the archive is deleted. ``sha256`` is the
    archive file's: the client's claim until the ingest stage has compared it. A drive by reference has a ``source``
    (``s3://bucket/prefix``) and no object of ours; its ``sha256`` is over its files' names and contents where it is a
    folder.
    """

    __tablename__ = "drives"
    noun = "drive"
    __table_args__ = (Index(None, "project_id", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str]
    filename: Mapped[str]
    sha256: Mapped[str | None] = mapped_column(String(64))
    size: Mapped[int]
    format: Mapped[str | None] = mapped_column(String(32))
    state: Mapped[DriveState] = mapped_column(default=DriveState.UPLOADED)
    problem: Mapped[Json | None]
    info: Mapped[Json | None]
    object_key: Mapped[str | None]
    source: Mapped[str | None]
    created_at: Mapped[datetime]
    deleted_at: Mapped[datetime | None]


class ModelRow(Owned, Base):
    """A model bundle; ``info`` once ready: ``{"label_space", "classes", "input": [height, width], "has_boundary"}``."""

    __tablename__ = "models"
    noun = "model"
    __table_args__ = (UniqueConstraint("project_id", "name"), Index(None, "project_id", "id"))

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    filename: Mapped[str]
    sha256: Mapped[str | None] = mapped_column(String(64))
    size: Mapped[int]
    state: Mapped[ModelState] = mapped_column(default=ModelState.UPLOADED)
    problem: Mapped[Json | None]
    info: Mapped[Json | None]
    object_key: Mapped[str | None]  # None once the archive is deleted
    created_at: Mapped[datetime]
    deleted_at: Mapped[datetime | None]


class AnnotationsRow(Owned, Base):
    """An archive of annotated images. Only a training looks into it; ``sha256`` is the client's claim until then."""

    __tablename__ = "annotations"
    noun = "annotations"
    __table_args__ = (Index(None, "project_id", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str]
    filename: Mapped[str]
    sha256: Mapped[str | None] = mapped_column(String(64))
    size: Mapped[int]
    object_key: Mapped[str | None]  # None once the archive is deleted
    created_at: Mapped[datetime]
    deleted_at: Mapped[datetime | None]


_JUDGED = text("quality IS NOT NULL")


class JobRow(Owned, Base):
    """One labelling of one drive with one model.

    ``settings``: ``{"preset", "segment", "formats": […], "protocol", "skip_bad_scans"}``.
    ``error``: ``{"message", "problems": […]}``. ``quality``: ``{"protocol", "primal": {…}, "refined": {…}}`` with
    ``Quality.as_dict()`` of each, or None where the log has no truth.
    """

    __tablename__ = "jobs"
    noun = "job"
    __table_args__ = (
        Index(None, "state"),
        Index(None, "project_id", "id"),
        Index(None, "project_id", "state", "id"),
        Index(None, "drive_id", "id"),
        Index(None, "model_id", "id"),
        Index(None, "deleted_at"),
        # Logs with truth are few; the metrics want the latest of their jobs.
        Index("ix_jobs_with_quality", "id", sqlite_where=_JUDGED, postgresql_where=_JUDGED),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    drive_id: Mapped[str] = mapped_column(ForeignKey("drives.id"))
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"))
    settings: Mapped[Json]
    state: Mapped[JobState] = mapped_column(default=JobState.QUEUED)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    error: Mapped[Json | None]
    quality: Mapped[Json | None]
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    deleted_at: Mapped[datetime | None]  # its labels are deleted; the row stays for the figures
    swept_at: Mapped[datetime | None]  # and when they had left the store


class TrainingRow(Owned, Base):
    """One training of a model on annotated images.

    ``name`` is the model's. ``settings``: what the client asked for, ``{"backbone", "recipe", "images", "size", …}``.
    ``figures``: the latest of each that the trainer told, ``{"loss", "miou" …}``; ``report``: its report, at the end.
    ``error``: ``{"message", "problems": […]}``. ``log_key`` names the log's object.
    """

    __tablename__ = "trainings"
    noun = "training"
    __table_args__ = (Index(None, "state"), Index(None, "name"), Index(None, "project_id", "id"))

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    annotations_id: Mapped[str] = mapped_column(ForeignKey("annotations.id"))
    validation_id: Mapped[str | None] = mapped_column(ForeignKey("annotations.id"))
    model_id: Mapped[str | None] = mapped_column(ForeignKey("models.id"))  # the model it became
    settings: Mapped[Json]
    state: Mapped[JobState] = mapped_column(default=JobState.QUEUED)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    figures: Mapped[Json | None]
    report: Mapped[Json | None]
    error: Mapped[Json | None]
    log_key: Mapped[str | None]
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]


class SceneRow(Base):
    """One scene of a job. ``quality``: ``{"protocol", "primal", "refined"}`` with the evaluators' states."""

    __tablename__ = "scenes"
    __table_args__ = (UniqueConstraint("job_id", "position"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    name: Mapped[str]
    position: Mapped[int]
    scans: Mapped[int]
    points: Mapped[int]
    state: Mapped[StageState] = mapped_column(default=StageState.QUEUED)
    quality: Mapped[Json | None]


class StageRow(Base):
    """One unit of work a worker can own.

    An ingest stage has a drive or a model, a publish stage a job, segment and refine stages a scene and its job, a
    train stage a training.
    ``progress_step`` is what the method is doing (``accumulate``, ``vote`` …), ``progress_done`` and ``progress_total``
    count its units, ``fraction`` (0..1) is over all steps of the stage. ``not_before`` holds back a retry.
    ``attempt`` only rises, so that no late message fits; ``failures`` counts the attempts that failed by a fault of the
    stage's own, ``losses`` those whose worker went as a whole, and ``outage_seconds`` is how long the stage has waited
    for what it stands on (l3ps_platform.workflow.retries).
    """

    __tablename__ = "stages"
    __table_args__ = (
        Index(None, "state", "lease_until"),
        Index(None, "state", "name", "queued_at"),
        Index(None, "job_id"),
        Index(None, "scene_id"),
        Index(None, "drive_id"),
        Index(None, "model_id"),
        Index(None, "training_id"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    scene_id: Mapped[str | None] = mapped_column(ForeignKey("scenes.id", ondelete="CASCADE"))
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    drive_id: Mapped[str | None] = mapped_column(ForeignKey("drives.id"))
    model_id: Mapped[str | None] = mapped_column(ForeignKey("models.id"))
    training_id: Mapped[str | None] = mapped_column(ForeignKey("trainings.id", ondelete="CASCADE"))
    name: Mapped[StageName]
    queue: Mapped[QueueName]
    state: Mapped[StageState] = mapped_column(default=StageState.WAITING)
    attempt: Mapped[int] = mapped_column(default=1)
    failures: Mapped[int] = mapped_column(default=0, server_default="0")
    losses: Mapped[int] = mapped_column(default=0, server_default="0")
    outage_seconds: Mapped[float] = mapped_column(default=0.0, server_default="0")
    not_before: Mapped[datetime | None]
    lease_owner: Mapped[str | None]
    lease_until: Mapped[datetime | None]
    progress_step: Mapped[str | None] = mapped_column(String(32))
    progress_done: Mapped[int] = mapped_column(default=0)
    progress_total: Mapped[int] = mapped_column(default=0)
    fraction: Mapped[float] = mapped_column(default=0.0)
    seconds: Mapped[float | None]
    cpu_seconds: Mapped[float | None]
    peak_mb: Mapped[float | None]
    scans: Mapped[int | None]
    points: Mapped[int | None]
    cached: Mapped[bool] = mapped_column(default=False)
    output_key: Mapped[str | None]
    error: Mapped[Json | None]
    queued_at: Mapped[datetime | None]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]


class StepRow(Base):
    """What a step inside a stage cost (``accumulate``, ``cluster`` …), for the metrics and the job's page."""

    __tablename__ = "steps"

    stage_id: Mapped[str] = mapped_column(ForeignKey("stages.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(String(32), primary_key=True)
    seconds: Mapped[float]
    peak_mb: Mapped[float]
