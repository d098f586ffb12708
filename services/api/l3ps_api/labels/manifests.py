"""What a finished job published: its manifest, and the files in it that were asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from l3ps_api.labels.schemas import Side
from l3ps_api.problems import ApiProblem, conflict, invalid
from l3ps_api.services import Services
from l3ps_platform.catalog import JobRow, JobState, StageName, jobs, stages
from l3ps_platform.objects import ObjectStore


@dataclass(frozen=True, slots=True)
class Published:
    """Where a finished job's manifest lies, and what it was asked for.

    Attributes:
        job_id: the job.
        key: of the manifest.
        label_format: the format chosen of those it wrote.
        finished_at: the job's end.
    """

    job_id: str
    key: str
    label_format: str
    finished_at: datetime

    def manifest(self, store: ObjectStore) -> dict[str, Any]:
        """The manifest. ObjectMissing when the job has been deleted meanwhile."""
        document: dict[str, Any] = json.loads(store.get_bytes(self.key))
        return document

    def files(self, manifest: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Its entries of the chosen format, with those that belong to every format (poses)."""
        return (file for file in manifest["files"] if file["format"] in (None, self.label_format))


def published(services: Services, job_id: str, label_format: str | None) -> Published:
    """What a job published. NotFound; 409 while there is nothing; 422 for a format it did not write."""
    with services.catalog.reading() as session:
        job = jobs.get(session, job_id)
        publish = next((row for row in stages.of_job(session, job_id) if row.name is StageName.PUBLISH), None)
    if job.state is not JobState.SUCCEEDED or publish is None or publish.output_key is None:
        raise _no_labels(job)
    made: list[str] = job.settings["formats"]
    chosen = label_format or made[0]
    if chosen not in made:
        what = f"the job wrote {' and '.join(made)}, not {chosen}"
        raise invalid("query format", what, "Ask for a format it wrote, or submit a job that writes this one.")
    return Published(job_id, publish.output_key, chosen, job.finished_at or job.created_at)


def side_of(file: dict[str, Any]) -> Side | None:
    """Which labels a file holds: those of the images alone, or the refined ones; None for poses and the like."""
    first = str(file["path"]).partition("/")[0]
    return first if first in ("primal", "refined") else None  # type: ignore[return-value]


def _no_labels(job: JobRow) -> ApiProblem:
    if job.state.final:
        what, remedy = f"The job {job.state.value}, so it has no labels.", "GET the job to see why; submit a new one."
    else:
        what, remedy = f"The job is {job.state.value}; labels exist when it has succeeded.", "Ask again then."
    return conflict("no-labels", "There are no labels", f"{what} {remedy}", where="job", remedy=remedy)
