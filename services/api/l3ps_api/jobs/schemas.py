"""Jobs as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from l3ps_api.problems import ErrorItem, stored_items
from l3ps_platform.catalog import DriveRow, DriveState, JobRow, JobState, ModelRow, ModelState, StageState

Preset = Literal["paper", "best", "fast"]
Segment = Literal["fast", "balanced", "paper"]
LabelFormat = Literal["nuscenes", "semantickitti"]
Protocol = Literal["nuscenes", "paper", "semantickitti"]


class JobSettings(BaseModel):
    """How to label."""

    model: str = Field(max_length=200, description="Name or id of a model.")
    preset: Preset = "best"
    segment: Segment = Field(
        default="fast",
        description="How images are looked at: in one pass, in one of higher resolution where the model has a graph "
        "for it, or in the published tilings.",
    )
    formats: Annotated[
        list[LabelFormat],
        Field(min_length=1, max_length=len(get_args(LabelFormat)), description="Label formats to write."),
    ] = ["nuscenes"]
    protocol: Protocol | None = Field(
        default=None, description="Protocol of the quality figures; default: the one that belongs to the log's truth."
    )
    skip_bad_scans: bool = Field(default=False, description="Label the good scans of a log that has bad ones.")


class JobRequest(JobSettings):
    """What to label and how."""

    model_config = ConfigDict(extra="forbid")

    drive_id: str | None = Field(default=None, max_length=40, description="A drive; or else name a `source`.")
    source: str | None = Field(
        default=None,
        max_length=1100,
        description="`s3://bucket/prefix` of a log in a bucket that the service may read: an archive, or a folder of "
        "the log's files. It becomes a drive; nothing is copied but to a worker's scratch.",
        examples=["s3://fleet/2026/11/22/morning"],
    )


class DriveRef(BaseModel):
    id: str
    name: str
    state: DriveState


class ModelRef(BaseModel):
    id: str
    name: str
    state: ModelState


class Step(BaseModel):
    """What a step of the method cost inside a stage."""

    name: str
    seconds: float
    peak_mb: float


class Stage(BaseModel):
    """One unit of work that a worker takes."""

    id: str
    name: str = Field(description="`ingest`, `segment`, `refine`, `publish` or `train`.")
    state: StageState
    attempt: int
    step: str | None = Field(default=None, description="What the method is doing now.")
    done: int = Field(description="Units of the step that are finished.")
    total: int = Field(description="Units of the step in all, 0 while unknown.")
    fraction: float = Field(description="How much of the whole stage is done, 0 to 1.")
    cached: bool = Field(default=False, description="Whether the result came from an earlier job.")
    seconds: float | None = None
    cpu_seconds: float | None = None
    peak_mb: float | None = None
    points: int | None = None
    message: str | None = Field(default=None, description="Why it failed, if it did.")
    started_at: datetime | None = None
    finished_at: datetime | None = None
    steps: list[Step] = Field(default_factory=list)


class Scene(BaseModel):
    id: str
    name: str
    position: int
    scans: int
    points: int
    state: StageState
    stages: list[Stage]


class JobSummary(BaseModel):
    """A job without its scenes."""

    id: str
    drive: DriveRef
    model: ModelRef
    preset: str
    segment: str
    formats: list[str]
    protocol: str | None
    skip_bad_scans: bool
    state: JobState
    cancel_requested: bool
    progress: float = Field(ge=0, le=1, description="Share of the stages' work that is done.")
    message: str | None = Field(default=None, description="Why it failed, if it did.")
    errors: list[ErrorItem] = Field(default_factory=list)
    quality: dict[str, Any] | None = Field(
        default=None,
        description="Against the log's truth, where it has any: `protocol`, `primal` and `refined`, per cent.",
    )
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class Job(JobSummary):
    """A job in full."""

    stages: list[Stage] = Field(description="Stages of the whole job: the log's ingest and the publication.")
    scenes: list[Scene]


class JobPage(BaseModel):
    items: list[JobSummary]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")


def summary_fields(job: JobRow, drive: DriveRow, model: ModelRow, progress: float) -> dict[str, Any]:
    """The fields of a summary from a job's rows."""
    error = job.error or {}
    return {
        **{name: job.settings.get(name) for name in ("preset", "formats", "protocol", "skip_bad_scans")},
        "segment": job.settings.get("segment", "fast"),
        "id": job.id,
        "drive": DriveRef(id=drive.id, name=drive.name, state=drive.state),
        "model": ModelRef(id=model.id, name=model.name, state=model.state),
        "state": job.state,
        "cancel_requested": job.cancel_requested,
        "progress": progress,
        "message": error.get("message"),
        "errors": stored_items(error.get("problems")),
        "quality": job.quality,
        "created_at": job.created_at,
        "started_at": job.started_at,
        "finished_at": job.finished_at,
    }
