"""Drives as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, Field

from l3ps_api.problems import ErrorItem, stored_items
from l3ps_platform.catalog import DriveRow, DriveState
from l3ps_platform.workflow import MAX_PROBLEMS, problem_count


class DriveScene(BaseModel):
    name: str
    scans: int
    points: int


class DriveInfo(BaseModel):
    """What the check found in the log."""

    scenes: list[DriveScene]
    scans: int
    points: int
    has_truth: bool
    truth_space: str | None = None


class Drive(BaseModel):
    """A drive log."""

    id: str
    name: str
    filename: str
    size: int = Field(description="Bytes of the archive, or of a folder's files; 0 while unknown.")
    sha256: str | None = None
    source: str | None = Field(default=None, description="`s3://bucket/prefix` of a drive by reference.")
    format: str | None = Field(default=None, description="`nuscenes`, `kitti-raw` or `semantickitti`, once checked.")
    state: DriveState
    problems: list[ErrorItem] = Field(
        default_factory=list,
        description="Why it was rejected; or, of a ready drive, the scans that a job can skip and warnings. The worst "
        f"come first, and not more than {MAX_PROBLEMS}.",
    )
    problem_count: int = Field(default=0, description="How many problems there are in all.")
    info: DriveInfo | None = None
    created_at: datetime

    @classmethod
    def of(cls, row: DriveRow) -> Drive:
        """The document of a row."""
        stored: dict[str, Any] = row.problem or {}
        return cls(
            id=row.id,
            name=row.name,
            filename=row.filename,
            size=row.size,
            sha256=row.sha256,
            source=row.source,
            format=row.format,
            state=row.state,
            problems=stored_items(stored.get("problems", [])[:MAX_PROBLEMS]),
            problem_count=problem_count(row.problem),
            info=DriveInfo.model_validate(row.info) if row.info else None,
            created_at=row.created_at,
        )


class DrivePage(BaseModel):
    items: list[Drive]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
