"""From a finished job's manifest to presigned URLs."""

from __future__ import annotations

import json
from typing import Any

from l3ps_api.labels.schemas import LabelFile, LabelFiles
from l3ps_api.problems import ApiProblem, conflict, invalid
from l3ps_api.services import Services
from l3ps_platform.catalog import JobRow, JobState, StageName, jobs, stages


def files(services: Services, job_id: str, label_format: str | None) -> LabelFiles:
    """The files of one format, with those that belong to every format (poses). NotFound for the job."""
    with services.catalog.reading() as session:
        job = jobs.get(session, job_id)
        publish = next((row for row in stages.of_job(session, job_id) if row.name is StageName.PUBLISH), None)
    if job.state is not JobState.SUCCEEDED or publish is None or publish.output_key is None:
        raise _no_labels(job)
    made: list[str] = job.settings["formats"]
    chosen = label_format or made[0]
    if chosen not in made:
        what = f"the job wrote {' and '.join(made)}, not {chosen}"
        raise invalid("format", what, "Ask for a format it wrote, or submit a job that writes this one.")
    manifest: dict[str, Any] = json.loads(services.store.get_bytes(publish.output_key))
    seconds = services.settings.url_ttl_seconds
    listed = [
        LabelFile(
            path=file["path"],
            size=file["size"],
            sha256=file["sha256"],
            url=services.store.presign_get(file["key"], seconds, file["path"].rpartition("/")[2]),
        )
        for file in manifest["files"]
        if file["format"] in (None, chosen)
    ]
    return LabelFiles(job_id=job_id, format=chosen, files=listed)


def _no_labels(job: JobRow) -> ApiProblem:
    if job.state.final:
        what, remedy = f"The job {job.state.value}, so it has no labels.", "GET the job to see why; submit a new one."
    else:
        what, remedy = f"The job is {job.state.value}; labels exist when it has succeeded.", "Ask again then."
    return conflict("no-labels", "There are no labels", f"{what} {remedy}", where="job", remedy=remedy)
