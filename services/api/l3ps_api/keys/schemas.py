"""API keys as clients see them."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

from l3ps_api.keyring import Scope
from l3ps_api.moments import Moment
from l3ps_api.uploads.schemas import Name
from l3ps_platform.catalog import ApiKeyRow

_WEEK = 7 * 24 * 3600


class KeyRequest(BaseModel):
    """A key to be made."""

    model_config = ConfigDict(extra="forbid")

    name: Name = Field(description="Who or what uses it.")
    scope: Scope = Field(
        description="`read`: GET; `write`: uploads, drives, models, jobs and trainings too; `admin`: keys, webhooks, "
        "rules and retention too."
    )
    expires_at: Moment | None = Field(default=None, description="When it ends; default: never.")


class Rotation(BaseModel):
    """How to change a key's secret."""

    model_config = ConfigDict(extra="forbid")

    overlap_seconds: int = Field(default=0, ge=0, le=_WEEK, description="How long the old secret stays good.")


class Key(BaseModel):
    """A key to the project."""

    id: str
    name: str
    scope: Scope
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = Field(default=None, description="To the minute.")
    previous_until: datetime | None = Field(default=None, description="Until when the secret before is good as well.")

    @classmethod
    def of(cls, row: ApiKeyRow) -> Key:
        """The document of a row."""
        return cls.model_validate(row, from_attributes=True)


class KeyWithSecret(Key):
    """A key whose secret is shown this once."""

    secret: str | None = Field(
        description="Shown this once and kept as a hash alone. Absent from the answer to a repeated request: rotate "
        "the key for a new one."
    )


class KeyPage(BaseModel):
    items: list[Key]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
