"""The labels of a finished job."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from l3ps_api.jobs.schemas import LabelFormat
from l3ps_api.labels import service
from l3ps_api.labels.schemas import LabelFiles
from l3ps_api.services import ServicesDep

router = APIRouter(prefix="/v1/jobs/{job_id}/labels", tags=["labels"])


@router.get("")
def list_labels(
    job_id: str,
    services: ServicesDep,
    label_format: Annotated[
        LabelFormat | None, Query(alias="format", description="Default: the first the job was asked for.")
    ] = None,
) -> LabelFiles:
    """A finished job's files with their checksums and presigned URLs."""
    return service.files(services, job_id, label_format)
