"""The labels of finished jobs: listed, one by one, or as an archive."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import RedirectResponse

from l3ps_api.auth import PrincipalDep
from l3ps_api.jobs.schemas import LabelFormat
from l3ps_api.labels import service
from l3ps_api.labels.archive import LabelArchive
from l3ps_api.labels.schemas import ALL_AT_ONCE, MOST_AT_ONCE, LabelFiles, Side
from l3ps_api.places import Places
from l3ps_api.ranges import RangedResponse
from l3ps_api.services import Services, ServicesDep
from l3ps_platform.objects import attachment

router = APIRouter(prefix="/v1", tags=["labels"])

FormatQuery = Annotated[
    LabelFormat | None, Query(alias="format", description="Default: the first the job was asked for.")
]
_LIMIT = f"How many files at most. Default: all of them, where there are no more than {ALL_AT_ONCE}."
_TAR: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/x-tar": {}}, "description": "The archive."},
    206: {"content": {"application/x-tar": {}}, "description": "The range of it that was asked for."},
    304: {"description": "It has not changed."},
}
_REDIRECT: dict[int | str, dict[str, Any]] = {
    307: {"description": "The file is at the `Location`, without further credentials."}
}


async def _place(request: Request, principal: PrincipalDep) -> AsyncIterator[None]:
    places: Places = request.app.state.archives
    with places.hold(principal.project_id):
        yield  # until the archive has been sent


_PLACED = [Depends(_place)]


@router.get("/jobs/{job_id}/labels")
def list_labels(
    job_id: str,
    services: ServicesDep,
    label_format: FormatQuery = None,
    side: Annotated[Side | None, Query(description="Only labels of the images alone, or refined ones.")] = None,
    scene: Annotated[str | None, Query(description="Only files of this scene.", max_length=300)] = None,
    scan: Annotated[str | None, Query(description="Only files of this scan.", max_length=300)] = None,
    limit: Annotated[int | None, Query(ge=1, le=MOST_AT_ONCE, description=_LIMIT)] = None,
    cursor: Annotated[str | None, Query(pattern="^[0-9]{1,9}$", description="`next` of the page before.")] = None,
) -> LabelFiles:
    """A finished job's files with their checksums and presigned URLs."""
    return service.files(services, job_id, label_format, limit=limit, cursor=cursor, side=side, scene=scene, scan=scan)


@router.head("/jobs/{job_id}/labels.tar", response_class=Response, dependencies=_PLACED, include_in_schema=False)
@router.get("/jobs/{job_id}/labels.tar", response_class=Response, dependencies=_PLACED, responses=_TAR)
def get_archive(job_id: str, services: ServicesDep, label_format: FormatQuery = None) -> Response:
    """All files of a finished job as one tar. It can be resumed at any byte: `Range`, with `If-Match` or `If-Range`."""
    return _archive(services, [job_id], label_format, f"{job_id}.tar")


@router.head("/labels.tar", response_class=Response, dependencies=_PLACED, include_in_schema=False)
@router.get("/labels.tar", response_class=Response, dependencies=_PLACED, responses=_TAR)
def get_archive_of_several(
    services: ServicesDep,
    job: Annotated[list[str], Query(min_length=1, max_length=100, description="The jobs, a folder each.")],
    label_format: FormatQuery = None,
) -> Response:
    """The files of several finished jobs as one tar, with a folder for each."""
    return _archive(services, list(dict.fromkeys(job)), label_format, "labels.tar")


@router.get("/jobs/{job_id}/labels/{path:path}", response_class=RedirectResponse, status_code=307, responses=_REDIRECT)
def get_label(job_id: str, path: str, services: ServicesDep) -> RedirectResponse:
    """One file, by the path that the listing gives it."""
    return RedirectResponse(service.url(services, job_id, path), 307)


def _archive(services: Services, job_ids: list[str], label_format: str | None, filename: str) -> RangedResponse:
    archive = LabelArchive(services, job_ids, label_format)
    headers = {"Content-Disposition": attachment(filename)}
    return RangedResponse(archive.read, archive.size, archive.etag, "application/x-tar", headers)
