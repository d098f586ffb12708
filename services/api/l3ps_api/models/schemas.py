"""Model bundles as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import BaseModel, Field, StringConstraints

from l3ps_api.problems import ErrorItem, stored_items
from l3ps_platform.catalog import ModelRow, ModelState

MODEL_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
ModelName = Annotated[str, StringConstraints(pattern=MODEL_NAME)]


class Model(BaseModel):
    """A model bundle."""

    id: str
    name: str
    filename: str
    size: int = Field(description="Bytes of the zip.")
    sha256: str | None = None
    state: ModelState
    problems: list[ErrorItem] = Field(default_factory=list, description="Why it was rejected.")
    info: dict[str, Any] | None = Field(
        default=None, description="Label space, classes and input size, once checked; the report of one trained here."
    )
    created_at: datetime

    @classmethod
    def of(cls, row: ModelRow) -> Model:
        """The document of a row."""
        stored: dict[str, Any] = row.problem or {}
        return cls(
            id=row.id,
            name=row.name,
            filename=row.filename,
            size=row.size,
            sha256=row.sha256,
            state=row.state,
            problems=stored_items(stored.get("problems")),
            info=row.info,
            created_at=row.created_at,
        )


class ModelPage(BaseModel):
    items: list[Model]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
