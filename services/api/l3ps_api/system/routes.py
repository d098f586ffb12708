"""Health, readiness and metrics: asked by machines of the same network, so they need no token."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from pydantic import BaseModel, Field

from l3ps_api.services import SystemDep
from l3ps_api.system.checks import check_all

router = APIRouter(tags=["system"])


class Health(BaseModel):
    status: str = "ok"


class Readiness(BaseModel):
    status: str = "ready"
    checks: dict[str, str] = Field(description="What was asked and how it answered.")


class Index(BaseModel):
    """Where to go from here."""

    service: str = "l3ps"
    version: str
    documentation: str = "/docs"
    openapi: str = "/openapi.json"
    health: list[str] = ["/healthz", "/readyz", "/metrics"]


@router.get("/")
async def index(request: Request) -> Index:
    """What this is and where its documentation lies."""
    return Index(version=request.app.version)


@router.get("/healthz")
async def healthz() -> Health:
    """Whether the process answers at all."""
    return Health()


@router.get("/readyz")
def readyz(services: SystemDep) -> Readiness:
    """Whether catalog, object store and queue answer; 503 names those that do not."""
    return Readiness(checks=check_all(services))


@router.get("/metrics", response_class=Response)
def metrics(request: Request) -> Response:
    """Prometheus metrics, those of the service computed from the catalog at this moment."""
    return Response(generate_latest(request.app.state.registry), media_type=CONTENT_TYPE_LATEST)
