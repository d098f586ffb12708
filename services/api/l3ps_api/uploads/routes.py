"""Uploads: announce a file, PUT its parts to the URLs answered, complete."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from l3ps_api.annotation_sets.schemas import Annotations
from l3ps_api.drives.schemas import Drive
from l3ps_api.models.schemas import Model
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of
from l3ps_api.uploads import service
from l3ps_api.uploads.schemas import (
    Completion,
    OpenUpload,
    PartsWanted,
    PartUrls,
    UploadPage,
    UploadProgress,
    UploadRequest,
)
from l3ps_platform.catalog import UploadState

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])
_FOLDERS = {Drive: "drives", Model: "models", Annotations: "annotations"}


@router.post("", status_code=201)
def open_upload(request: UploadRequest, response: Response, services: ServicesDep) -> OpenUpload:
    """Announce a file; the answer holds a presigned URL for each part."""
    upload = service.open_upload(services, request)
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    response.headers["Cache-Control"] = "no-store"  # its URLs let whoever has them write
    return upload


@router.get("")
def list_uploads(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("upl")] = None,
    state: Annotated[UploadState | None, Query(description="Only uploads in this state.")] = None,
) -> UploadPage:
    """Uploads, newest first; `state=open` finds those that a client left unfinished."""
    return service.page(services, limit, cursor, state)


@router.get("/{upload_id}")
def get_upload(upload_id: str, services: ServicesDep) -> UploadProgress:
    """An upload's state and the parts that have arrived, with which a client goes on after an interruption."""
    return service.get(services, upload_id)


@router.post("/{upload_id}/parts")
def presign_parts(upload_id: str, wanted: PartsWanted, response: Response, services: ServicesDep) -> PartUrls:
    """Fresh URLs for parts of an open upload."""
    response.headers["Cache-Control"] = "no-store"
    return service.urls(services, upload_id, wanted.numbers)


@router.post("/{upload_id}/complete", status_code=202)
def complete_upload(
    upload_id: str, completion: Completion, response: Response, services: ServicesDep
) -> Drive | Model | Annotations:
    """Join the parts. A file that is no archive is refused and forgotten; any other is checked by a worker.

    Annotations are looked into when a training uses them.
    """
    result = service.complete(services, upload_id, completion)
    response.headers["Location"] = f"/v1/{_FOLDERS[type(result)]}/{result.id}"
    return result


@router.delete("/{upload_id}", status_code=204)
def abort_upload(upload_id: str, services: ServicesDep) -> None:
    """Give an upload up; its parts are deleted."""
    service.abort(services, upload_id)
