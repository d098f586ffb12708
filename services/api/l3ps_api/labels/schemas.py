"""Label files as clients see them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

Side = Literal["primal", "refined"]
ALL_AT_ONCE = 10_000
"""Files listed where no limit is named: a quarter of a second's work."""
MOST_AT_ONCE = 1000
"""Files on a page."""


class LabelFile(BaseModel):
    path: str = Field(description="Path below the directory the files go to.", examples=["refined/lidarseg/a.bin"])
    size: int
    sha256: str
    side: Side | None = Field(default=None, description="Of the images alone, or refined; absent for poses.")
    scene: str | None = Field(default=None, description="The scene it belongs to; absent for files of the whole job.")
    scan: str | None = Field(default=None, description="The scan it belongs to; absent for files of several scans.")
    url: str = Field(description="Where to GET it, without further credentials; valid for an hour or as configured.")


class LabelFiles(BaseModel):
    """A finished job's files in one format, or a page of them."""

    job_id: str
    format: str
    files: list[LabelFile]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
