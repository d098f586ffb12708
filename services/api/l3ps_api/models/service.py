"""Model bundles."""

from __future__ import annotations

from l3ps_api.models.schemas import Model, ModelPage
from l3ps_api.pages import cut
from l3ps_api.services import Services
from l3ps_platform.catalog import bundles


def page(services: Services, limit: int, cursor: str | None) -> ModelPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = bundles.page(session, limit=limit + 1, before=cursor)
    shown, following = cut(rows, limit)
    return ModelPage(items=[Model.of(row) for row in shown], next=following)


def get(services: Services, model: str) -> Model:
    """One model by name or id. NotFound."""
    with services.catalog.reading() as session:
        return Model.of(bundles.by_name(session, model))


def delete(services: Services, model: str) -> None:
    """Hide a model at once; the reconciler deletes its archive. NotFound, Conflict while in use."""
    with services.catalog.transaction() as tx:
        bundles.delete(tx, bundles.by_name(tx.session, model).id)
