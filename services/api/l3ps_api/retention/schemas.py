"""What a project keeps, as clients see it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Retention(BaseModel):
    """The limits beyond which finished jobs and unused drives are deleted, the oldest first. `null` is no limit."""

    model_config = ConfigDict(extra="forbid")

    max_age_days: int | None = Field(
        ge=1, le=36_500, description="Days after its end that a job's labels are kept, and a drive after its last job."
    )
    max_bytes: int | None = Field(
        ge=0, le=1 << 60, description="Bytes that all labels and drive archives of the project may have together."
    )


class RetentionState(Retention):
    """The limits, and what they are held against."""

    stored_bytes: int = Field(description="Bytes of the labels and drive archives that there are.")
