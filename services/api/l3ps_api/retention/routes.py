"""How long a project keeps what it has."""

from __future__ import annotations

from fastapi import APIRouter

from l3ps_api.retention import service
from l3ps_api.retention.schemas import Retention, RetentionState
from l3ps_api.services import ServicesDep

router = APIRouter(prefix="/v1/retention", tags=["retention"])


@router.get("")
def get_retention(services: ServicesDep) -> RetentionState:
    """The project's limits and how much there is."""
    return service.get(services)


@router.put("")
def put_retention(request: Retention, services: ServicesDep) -> RetentionState:
    """Set the limits. What is beyond them goes within minutes; what an unfinished job refers to never does."""
    return service.put(services, request)
