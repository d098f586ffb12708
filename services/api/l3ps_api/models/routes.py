"""Model bundles that the service knows."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter

from l3ps_api.models import service
from l3ps_api.models.schemas import Model, ModelPage
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of

router = APIRouter(prefix="/v1/models", tags=["models"])


@router.get("")
def list_models(services: ServicesDep, limit: Limit = 50, cursor: Annotated[Cursor, id_of("mdl")] = None) -> ModelPage:
    """Models, newest first. A new one comes as an upload of kind `model`, or is trained."""
    return service.page(services, limit, cursor)


@router.get("/{model}")
def get_model(model: str, services: ServicesDep) -> Model:
    """A model by its name or id."""
    return service.get(services, model)


@router.delete("/{model}", status_code=204)
def delete_model(model: str, services: ServicesDep) -> None:
    """Delete a model, by its name or id, and free its name. Refused while a job uses it; labels made with it stay."""
    service.delete(services, model)
