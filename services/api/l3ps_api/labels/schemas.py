"""Label files as clients see them."""

from __future__ import annotations

from pydantic import BaseModel, Field


class LabelFile(BaseModel):
    path: str = Field(description="Path below the directory the files go to.", examples=["refined/lidarseg/a.bin"])
    size: int
    sha256: str
    url: str = Field(description="Where to GET it, without further credentials; valid for an hour or as configured.")


class LabelFiles(BaseModel):
    """A finished job's files in one format."""

    job_id: str
    format: str
    files: list[LabelFile]
