"""Archives of annotated images."""

from __future__ import annotations

from l3ps_api.annotation_sets.schemas import Annotations, AnnotationsPage
from l3ps_api.pages import cut
from l3ps_api.services import Services
from l3ps_platform.catalog import annotation_sets


def page(services: Services, limit: int, cursor: str | None, sha256: str | None) -> AnnotationsPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = annotation_sets.page(session, limit=limit + 1, before=cursor, sha256=sha256)
    shown, following = cut(rows, limit)
    return AnnotationsPage(items=[Annotations.of(row) for row in shown], next=following)


def get(services: Services, annotations_id: str) -> Annotations:
    """One archive. NotFound."""
    with services.catalog.reading() as session:
        return Annotations.of(annotation_sets.get(session, annotations_id))


def delete(services: Services, annotations_id: str) -> None:
    """Hide an archive at once; the reconciler deletes its bytes. NotFound, Conflict while in use."""
    with services.catalog.transaction() as tx:
        annotation_sets.delete(tx, annotations_id)
