"""Annotations: the archives of annotated images that were uploaded."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from l3ps_api.annotation_sets import service
from l3ps_api.annotation_sets.schemas import Annotations, AnnotationsPage
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of

router = APIRouter(prefix="/v1/annotations", tags=["training"])


@router.get("")
def list_annotations(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("ann")] = None,
    sha256: Annotated[str | None, Query(description="Only archives of these bytes.", max_length=64)] = None,
) -> AnnotationsPage:
    """Annotations, newest first. New ones come as an upload of kind `annotations`."""
    return service.page(services, limit, cursor, sha256)


@router.get("/{annotations_id}")
def get_annotations(annotations_id: str, services: ServicesDep) -> Annotations:
    """An archive of annotated images."""
    return service.get(services, annotations_id)


@router.delete("/{annotations_id}", status_code=204)
def delete_annotations(annotations_id: str, services: ServicesDep) -> None:
    """Delete an archive. Refused while a training uses it; models that were trained on it stay."""
    service.delete(services, annotations_id)
