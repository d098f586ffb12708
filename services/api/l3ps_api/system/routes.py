"""Health, readiness and metrics: asked by machines of the same network, so they need no credentials of the API."""

from __future__ import annotations

import hmac

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from l3ps_api.problems import fault
from l3ps_api.system.shared import Shared

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
async def readyz(request: Request) -> Readiness:
    """Whether catalog, object store and queue answer; 503 names those that do not."""
    checks: Shared[dict[str, str]] = request.app.state.readiness
    return Readiness(checks=await checks.get())


@router.get("/metrics", response_class=Response)
async def metrics(request: Request) -> Response:
    """Prometheus metrics, those of the service computed from the catalog at this moment.

    With the bearer token L3PS_METRICS_TOKEN, where the service has one.
    """
    _admit(request)
    page: Shared[bytes] = request.app.state.metrics
    return Response(await page.get(), media_type=CONTENT_TYPE_LATEST)


def _admit(request: Request) -> None:
    wanted = request.app.state.services.settings.metrics_token
    if wanted is None:
        return
    given = request.headers.get("authorization", "").encode("latin-1")
    if not hmac.compare_digest(given, b"Bearer " + wanted.get_secret_value().encode()):
        what, remedy = "the metrics are for those who have their token", "Send it: `Bearer` and L3PS_METRICS_TOKEN."
        headers = {"WWW-Authenticate": "Bearer"}
        raise fault(401, "unauthorized", "Unauthorized", "Authorization", what, remedy, headers)
