"""Jobs: one labelling of one drive with one model."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import AwareDatetime

from l3ps_api.auth import PrincipalDep
from l3ps_api.jobs import service
from l3ps_api.jobs.schemas import Job, JobPage, JobRequest
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of
from l3ps_platform.catalog import JobState, jobs

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.post("", status_code=202)
def create_job(request: JobRequest, response: Response, services: ServicesDep, principal: PrincipalDep) -> Job:
    """Start a job. On a drive that is still being checked it waits; on a rejected drive it is refused."""
    job = service.create(services, principal.project_id, request)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.get("")
def list_jobs(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("job")] = None,
    state: Annotated[
        list[JobState] | None, Query(description="Only jobs in this state; may be given several times.")
    ] = None,
    drive_id: Annotated[str | None, Query(max_length=40, description="Only jobs on this drive.")] = None,
    model_id: Annotated[str | None, Query(max_length=40, description="Only jobs with this model.")] = None,
    created_after: Annotated[
        AwareDatetime | None,
        Query(description="Only jobs made then or later, as 2026-01-31T12:00:00Z."),
    ] = None,
    created_before: Annotated[AwareDatetime | None, Query(description="Only jobs made earlier.")] = None,
) -> JobPage:
    """Jobs, newest first. All conditions that are given hold."""
    wanted = jobs.Wanted(state or (), drive_id, model_id, created_after, created_before)
    return service.page(services, limit, cursor, wanted)


@router.get("/{job_id}", response_model=Job)
def get_job(job_id: str, services: ServicesDep) -> Response:
    """A job with the progress and cost of each scene's stages and, at its end, its quality."""
    return Response(service.encoded(services, job_id), media_type="application/json")


@router.post("/{job_id}/cancel", status_code=202)
def cancel_job(job_id: str, services: ServicesDep) -> Job:
    """Ask a job to stop; what runs stops at its next scan. Refused when it has succeeded or failed."""
    return service.cancel(services, job_id)


@router.post("/{job_id}/retry", status_code=202)
def retry_job(job_id: str, services: ServicesDep) -> Job:
    """Run a failed or cancelled job again: only what is missing. Refused in every other state."""
    return service.retry(services, job_id)


@router.delete("/{job_id}", status_code=204)
def delete_job(job_id: str, services: ServicesDep) -> None:
    """Delete a finished job and its labels. Refused while it is not over; what other jobs share with it stays."""
    service.delete(services, job_id)
