"""The directory store's presigned URLs, answered as an S3 server would answer its own."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response

from l3ps_api.objects import service
from l3ps_api.services import SystemDep

router = APIRouter(prefix="/v1/objects", tags=["objects"])

_PARTIAL: dict[int | str, dict[str, Any]] = {
    206: {"description": "The range that was asked for."},
    304: {"description": "It has not changed."},
}


@router.put("/{key:path}", status_code=200, response_class=Response)
async def put_object(key: str, request: Request, services: SystemDep) -> Response:
    """Store the body as the object or part that the URL's signature permits; the answer's ETag names a part."""
    grant = service.grant(services, "PUT", key, request.query_params)
    etag = await service.receive(services, grant, request.headers.get("content-length"), request.stream())
    return Response(headers={"ETag": f'"{etag}"'})


@router.head("/{key:path}", response_class=Response, include_in_schema=False)
@router.get("/{key:path}", response_class=Response, responses=_PARTIAL)
def get_object(key: str, request: Request, services: SystemDep) -> Response:
    """Send the object that the URL's signature permits; one `Range`, `If-Range` and `If-None-Match` are honoured."""
    return service.send(services, service.grant(services, request.method, key, request.query_params))
