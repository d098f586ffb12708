"""Projects, and the caller, as clients see them."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

from l3ps_api.keyring import Scope
from l3ps_api.uploads.schemas import Name
from l3ps_platform.catalog import ProjectRow


class ProjectRequest(BaseModel):
    """A project to be made."""

    model_config = ConfigDict(extra="forbid")

    name: Name


class Project(BaseModel):
    """What keeps a team's drives, models, jobs and labels apart from those of others."""

    id: str
    name: str
    created_at: datetime

    @classmethod
    def of(cls, row: ProjectRow) -> Project:
        """The document of a row."""
        return cls(id=row.id, name=row.name, created_at=row.created_at)


class ProjectPage(BaseModel):
    items: list[Project]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")


class ProjectRef(BaseModel):
    id: str
    name: str


class KeyRef(BaseModel):
    id: str
    name: str


class Me(BaseModel):
    """The caller."""

    project: ProjectRef
    scope: Scope
    key: KeyRef | None = Field(default=None, description="Its API key; absent for the operator.")
