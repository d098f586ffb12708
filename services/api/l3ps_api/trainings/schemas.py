"""Trainings as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from l3ps_api.jobs.schemas import ModelRef, Stage
from l3ps_api.models.schemas import ModelName
from l3ps_api.problems import ErrorItem, stored_items
from l3ps_platform.catalog import AnnotationsRow, JobState, ModelRow, TrainingRow

Word = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
PRINTABLE = r"^[^\x00-\x1f\x7f]+$"
"""Control characters are nobody's name: PostgreSQL refuses some, and terminals obey others."""
Label = Annotated[str, StringConstraints(max_length=100, pattern=PRINTABLE)]
Key = Annotated[int, Field(ge=0, lt=1 << 31)] | Label
"""What stands for a class: its number or name in the annotations."""
Side = Annotated[int, Field(ge=32, le=4096)]
AnnotationFormat = Literal["auto", "plain", "cityscapes", "coco", "nuimages"]


class AnnotatedClass(BaseModel):
    model_config = ConfigDict(extra="forbid")

    id: Key | None = Field(default=None, description="Number or name in the annotations; default: the category.")
    category: Label | None = Field(default=None, description="The same, of formats that name them; default: the name.")
    name: Label
    nuscenes: Key | None = Field(
        default=None,
        description="Class of Panoptic nuScenes that it counts as, by name or number, `void` for none; may be left out "
        "where the name says it.",
    )


class Classes(BaseModel):
    """What the numbers in the annotations mean, where the archive does not say it itself: a classes file, inline."""

    model_config = ConfigDict(extra="forbid")

    classes: Annotated[list[AnnotatedClass], Field(min_length=1, max_length=1000)]
    void: list[Key] = Field(default_factory=list, max_length=1000, description="What is not annotated.")


class TrainingSettings(BaseModel):
    """How to train; what is left out is the trainer's choice."""

    model_config = ConfigDict(extra="forbid")

    backbone: Word = Field(
        description="Name of a pretrained backbone of this service; `scratch` trains a small encoder from nothing.",
        examples=["espnetv2-features"],
    )
    recipe: Word | None = Field(default=None, description="Name of a recipe: head, loss, augmentation and schedule.")
    format: AnnotationFormat = Field(default="auto", description="Of the annotations; `auto` looks at the files.")
    classes: Classes | None = None
    images: int | None = Field(default=None, ge=1, le=1_000_000, description="Learn from so many, spread over all.")
    size: tuple[Side, Side] | None = Field(default=None, description="Height and width of the network's input.")
    balanced: tuple[Side, Side] | None = Field(
        default=None, description="A second, larger input for the preset `balanced`: height and width."
    )
    epochs: int | None = Field(default=None, ge=1, le=100_000)
    seed: int = Field(default=0, ge=0, lt=1 << 31)
    int8: bool = Field(default=False, description="Quantise, and keep that where validation allows it.")


class TrainingRequest(TrainingSettings):
    """What to train from and how."""

    name: ModelName = Field(description="What the model is to be called.")
    annotations: str = Field(max_length=40, description="Id of annotations, or of the upload they came as.")
    validation: Annotated[float, Field(gt=0, lt=1)] | Annotated[str, Field(max_length=40)] | None = Field(
        default=None,
        description="What to measure on: the same, or a share of the images to set aside. Without it nothing is "
        "measured, and how good the model is remains unknown.",
    )


class AnnotationsRef(BaseModel):
    id: str
    name: str


class TrainingSummary(BaseModel):
    """A training without its log and report."""

    id: str
    name: str = Field(description="Of the model.")
    annotations: AnnotationsRef
    validation: AnnotationsRef | None = None
    settings: dict[str, Any] = Field(description="As they were asked for; in a list without `classes`.")
    state: JobState
    cancel_requested: bool
    progress: float = Field(ge=0, le=1, description="Share of the work that is done.")
    figures: dict[str, Any] = Field(
        default_factory=dict, description="The latest of each that the trainer told, such as `loss` and `miou`."
    )
    model: ModelRef | None = Field(default=None, description="The model it became.")
    message: str | None = Field(default=None, description="Why it failed, if it did.")
    errors: list[ErrorItem] = Field(default_factory=list)
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class Training(TrainingSummary):
    """A training in full."""

    stage: Stage = Field(description="What it is doing and what it cost.")
    log: str = Field(default="", description="The end of what the trainer said.")
    log_url: str | None = Field(default=None, description="Presigned URL of all of it that is kept.")
    report: dict[str, Any] | None = Field(default=None, description="The trainer's report: IoU of each class and more.")
    bundle_url: str | None = Field(default=None, description="Presigned URL of the model's bundle, a zip.")


class TrainingPage(BaseModel):
    items: list[TrainingSummary]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")


def summary_fields(
    row: TrainingRow, sets: dict[str, AnnotationsRow], models: dict[str, ModelRow], progress: float
) -> dict[str, Any]:
    """The fields of a summary from a training's rows."""
    error = row.error or {}
    model = models.get(row.model_id or "")

    def named(id: str | None) -> AnnotationsRef | None:
        return AnnotationsRef(id=id, name=sets[id].name) if id is not None else None

    return {
        "id": row.id,
        "name": row.name,
        "annotations": named(row.annotations_id),
        "validation": named(row.validation_id),
        "settings": row.settings,
        "state": row.state,
        "cancel_requested": row.cancel_requested,
        "progress": 1.0 if row.state is JobState.SUCCEEDED else progress,
        "figures": row.figures or {},
        "model": ModelRef(id=model.id, name=model.name, state=model.state) if model else None,
        "message": error.get("message"),
        "errors": stored_items(error.get("problems")),
        "created_at": row.created_at,
        "started_at": row.started_at,
        "finished_at": row.finished_at,
    }
