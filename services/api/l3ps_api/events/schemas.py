"""Events as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, Field

from l3ps_platform.catalog import EventKind, JobState


class Event(BaseModel):
    """Something that happened: the `data` of a message whose `event` is its type and whose `id` is its number."""

    seq: int = Field(description="Its number; grows with time, with gaps.")
    type: EventKind
    timestamp: datetime
    subject: str = Field(description="The job, drive, model, training or webhook; of scenes and stages their job.")
    data: dict[str, Any] = Field(description="What there is to say; the same as a webhook's `data`.")


class RunningStage(BaseModel):
    id: str
    name: str
    scene: str | None = Field(description="Name of its scene, if it has one.")
    attempt: int
    step: str | None
    done: int
    total: int
    fraction: float = Field(ge=0, le=1)


class JobProgress(BaseModel):
    """How far a job is: the `data` of a message `progress`, sent whenever it has changed."""

    id: str
    state: JobState
    progress: float = Field(ge=0, le=1, description="Share of the stages' work that is done.")
    stages: dict[str, dict[str, int]] = Field(description="How many stages of each name are in each state.")
    running: list[RunningStage]
