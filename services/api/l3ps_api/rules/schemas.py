"""Rules as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from l3ps_api.jobs.schemas import JobSettings
from l3ps_api.problems import ErrorItem, stored_items
from l3ps_platform.catalog import ArrivalRow, RuleRow

Printable = r"^[^\x00-\x1f\x7f]*$"
RuleName = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=Printable)]


class RuleRequest(JobSettings):
    """What is to become of objects that arrive in a bucket: one job for each."""

    model_config = ConfigDict(extra="forbid")

    name: RuleName
    bucket: str = Field(max_length=63)
    prefix: str = Field(
        default="", max_length=1024, description="Only objects below it, by whole segments; empty: all of the bucket."
    )
    suffix: str | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        pattern=Printable,
        description="Only objects whose key ends so. Where it is no archive's suffix, as `_SUCCESS` or `.done`, such "
        "an object says that the folder it lies in is complete, and that folder is the log. Without it every archive "
        "(.zip, .tar, .tar.gz, .tgz, .tar.zst, .tzst) is a log.",
    )


class Arrival(BaseModel):
    """An object that met a rule."""

    key: str
    source: str = Field(description="The log, as a job by reference names it.")
    job_id: str | None = Field(default=None, description="The job it became; absent while it waits, or if it failed.")
    message: str | None = Field(default=None, description="Why it became none.")
    errors: list[ErrorItem] = Field(default_factory=list)
    created_at: datetime

    @classmethod
    def of(cls, row: ArrivalRow) -> Arrival:
        """The document of a row."""
        error = row.error or {}
        return cls(
            key=row.key,
            source=row.source,
            job_id=row.job_id,
            message=error.get("message"),
            errors=stored_items(error.get("problems")),
            created_at=row.created_at,
        )


class Rule(JobSettings):
    """A rule."""

    id: str
    name: str
    bucket: str
    prefix: str
    suffix: str | None = None
    arrivals: int = Field(description="Objects that have met it so far.")
    latest: Arrival | None = None
    created_at: datetime

    @classmethod
    def of(cls, row: RuleRow, arrivals: int = 0, latest: ArrivalRow | None = None) -> Rule:
        """The document of a row."""
        return cls(
            **row.settings,
            id=row.id,
            name=row.name,
            bucket=row.bucket,
            prefix=row.prefix,
            suffix=row.suffix,
            arrivals=arrivals,
            latest=None if latest is None else Arrival.of(latest),
            created_at=row.created_at,
        )


class RulePage(BaseModel):
    items: list[Rule]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
