"""Archives of annotated images as clients see them."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, Field

from l3ps_platform.catalog import AnnotationsRow


class Annotations(BaseModel):
    """An archive of annotated images. Only a training looks into it, and says what is wrong with it."""

    id: str
    name: str
    filename: str
    size: int = Field(description="Bytes of the archive.")
    sha256: str | None = None
    created_at: datetime

    @classmethod
    def of(cls, row: AnnotationsRow) -> Annotations:
        """The document of a row."""
        return cls(
            id=row.id,
            name=row.name,
            filename=row.filename,
            size=row.size,
            sha256=row.sha256,
            created_at=row.created_at,
        )


class AnnotationsPage(BaseModel):
    items: list[Annotations]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
