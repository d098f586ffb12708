"""Jobs: one labelling of one drive with one model."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from l3ps_api.jobs import service
from l3ps_api.jobs.schemas import Job, JobPage, JobRequest
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of
from l3ps_platform.catalog import JobState

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.post("", status_code=202)
def create_job(request: JobRequest, response: Response, services: ServicesDep) -> Job:
    """Start a job. On a drive that is still being checked it waits; on a rejected drive it is refused."""
    job = service.create(services, request)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.get("")
def list_jobs(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("job")] = None,
    state: Annotated[JobState | None, Query(description="Only jobs in this state.")] = None,
) -> JobPage:
    """Jobs, newest first."""
    return service.page(services, limit, cursor, state)


@router.get("/{job_id}")
def get_job(job_id: str, services: ServicesDep) -> Job:
    """A job with the progress and cost of each scene's stages and, at its end, its quality."""
    return service.get(services, job_id)


@router.post("/{job_id}/cancel", status_code=202)
def cancel_job(job_id: str, services: ServicesDep) -> Job:
    """Ask a job to stop; what runs stops at its next scan. Refused when it has succeeded or failed."""
    return service.cancel(services, job_id)
