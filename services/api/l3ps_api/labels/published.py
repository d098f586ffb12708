"""What a finished job published, and where."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from l3ps_api.problems import ApiProblem, conflict, invalid
from l3ps_api.services import Services
from l3ps_platform.catalog import JobRow, JobState, jobs, stages


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


def published(services: Services, job_id: str, label_format: str | None) -> Published:
    """What a job published. NotFound; 409 while there is nothing; 422 for a format it did not write."""
    with services.catalog.reading() as session:
        job = jobs.get(session, job_id)
        publish = stages.publishing(session, job_id)
    if job.state is not JobState.SUCCEEDED or publish is None or publish.output_key is None:
        raise _no_labels(job)
    made: list[str] = job.settings["formats"]
    chosen = label_format or made[0]
    if chosen not in made:
        what = f"the job wrote {' and '.join(made)}, not {chosen}"
        raise invalid("query format", what, "Ask for a format it wrote, or submit a job that writes this one.")
    return Published(job_id, publish.output_key, chosen, job.finished_at or job.created_at)


def _no_labels(job: JobRow) -> ApiProblem:
    if job.state.final:
        what, remedy = f"The job {job.state.value}, so it has no labels.", "GET the job to see why; submit a new one."
    else:
        what, remedy = f"The job is {job.state.value}; labels exist when it has succeeded.", "Ask again then."
    return conflict("no-labels", "There are no labels", f"{what} {remedy}", where="job", remedy=remedy)
