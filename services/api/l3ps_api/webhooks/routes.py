"""Webhooks: URLs that are told of events, by signed POSTs after the Standard Webhooks specification."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.concurrency import run_in_threadpool

from l3ps_api.services import Cursor, Limit, ServicesDep, id_of
from l3ps_api.webhooks import service
from l3ps_api.webhooks.schemas import (
    Delivery,
    DeliveryPage,
    NewWebhook,
    Replayed,
    ReplayRequest,
    Rotation,
    Webhook,
    WebhookChange,
    WebhookPage,
    WebhookRequest,
)
from l3ps_platform.catalog import DeliveryState

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])


@router.post("", status_code=201)
async def create_webhook(request: WebhookRequest, response: Response, services: ServicesDep) -> NewWebhook:
    """Have a URL told of events from now on. The answer holds the secret that messages are signed with."""
    await service.admit(services, request.url)
    webhook = await run_in_threadpool(service.create, services, request)
    response.headers["Location"] = f"/v1/webhooks/{webhook.id}"
    response.headers["Cache-Control"] = "no-store"
    return webhook


@router.get("")
def list_webhooks(
    services: ServicesDep, limit: Limit = 50, cursor: Annotated[Cursor, id_of("whk")] = None
) -> WebhookPage:
    """Webhooks, newest first."""
    return service.page(services, limit, cursor)


@router.get("/{webhook_id}")
def get_webhook(webhook_id: str, services: ServicesDep) -> Webhook:
    """A webhook, and how it fares."""
    return service.get(services, webhook_id)


@router.patch("/{webhook_id}")
async def change_webhook(webhook_id: str, request: WebhookChange, services: ServicesDep) -> Webhook:
    """Change a webhook, or switch it off or on."""
    if request.url is not None:
        await service.admit(services, request.url)
    return await run_in_threadpool(service.change, services, webhook_id, request)


@router.delete("/{webhook_id}", status_code=204)
def delete_webhook(webhook_id: str, services: ServicesDep) -> None:
    """Delete a webhook and the log of its deliveries."""
    service.delete(services, webhook_id)


@router.post("/{webhook_id}/rotate")
def rotate_secret(webhook_id: str, services: ServicesDep, request: Rotation | None = None) -> NewWebhook:
    """Give a webhook a new secret. While the old one overlaps, messages carry a signature by each."""
    return service.rotate(services, webhook_id, (request or Rotation()).overlap_seconds)


@router.post("/{webhook_id}/test", status_code=202)
def test_webhook(webhook_id: str, services: ServicesDep) -> Delivery:
    """Send a message of type `ping`; the log of deliveries tells what came of it."""
    return service.test(services, webhook_id)


@router.post("/{webhook_id}/replay", status_code=202)
def replay_failed(webhook_id: str, request: ReplayRequest, services: ServicesDep) -> Replayed:
    """Make all failed deliveries since a date again."""
    return service.replay_failed(services, webhook_id, request.since)


@router.get("/{webhook_id}/deliveries")
def list_deliveries(
    webhook_id: str,
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("msg")] = None,
    state: Annotated[DeliveryState | None, Query(description="Only deliveries in this state.")] = None,
) -> DeliveryPage:
    """The deliveries to a webhook with their attempts, newest first. The log goes back 30 days unless set otherwise."""
    return service.log(services, webhook_id, limit, cursor, state)


@router.post("/{webhook_id}/deliveries/{delivery_id}/replay", status_code=202)
def replay_delivery(webhook_id: str, delivery_id: str, services: ServicesDep) -> Delivery:
    """Make one delivery again, whatever came of it. It keeps its message id: a receiver that took it can tell."""
    return service.replay(services, webhook_id, delivery_id)
