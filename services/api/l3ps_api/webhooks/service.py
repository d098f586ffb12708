"""Webhooks."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta

from l3ps_api.pages import cut
from l3ps_api.problems import conflict, invalid
from l3ps_api.services import Services
from l3ps_api.webhooks.schemas import (
    Delivery,
    DeliveryPage,
    NewWebhook,
    Replayed,
    Webhook,
    WebhookChange,
    WebhookPage,
    WebhookRequest,
)
from l3ps_platform.catalog import DeliveryState, WebhookRow, webhooks
from l3ps_platform.catalog.requests import note_result
from l3ps_platform.errors import TargetRefused
from l3ps_platform.ids import new_id
from l3ps_platform.webhooks import Guard, new_secret
from l3ps_platform.workflow import deliveries

MAX_WEBHOOKS = 50
"""In a project. Whatever happens makes one row each, in the transaction in which it happens."""
RESOLVE_SECONDS = 5.0
_RESOLVERS = ThreadPoolExecutor(4, thread_name_prefix="resolver")
"""Threads of their own: a name server that does not answer keeps one for half a minute, whatever waits for it."""


async def admit(services: Services, url: str) -> None:
    """Raise a 422 problem unless a URL may be called now. Its host is looked up, by somebody else's name servers."""
    guard = Guard(services.settings.webhook_allow, http=services.settings.webhook_http)
    looked_up = asyncio.get_running_loop().run_in_executor(_RESOLVERS, guard.admit, url)
    try:
        await asyncio.wait_for(looked_up, RESOLVE_SECONDS)
    except TargetRefused as refusal:
        raise invalid("url", refusal.what, refusal.remedy, code="url-refused") from refusal
    except TimeoutError:
        what = f"its host was not found within {RESOLVE_SECONDS:g} s"
        raise invalid("url", what, "Try again later, or use another name.", code="url-refused") from None


def create(services: Services, request: WebhookRequest) -> NewWebhook:
    """A new webhook, whose URL has been admitted. 409 when there are too many."""
    with services.catalog.transaction() as tx:
        if webhooks.count(tx.session) >= MAX_WEBHOOKS:
            detail = f"The project has {MAX_WEBHOOKS} webhooks, which is as many as there can be."
            raise conflict("too-many-webhooks", "Too many webhooks", detail, where="url", remedy="Delete one first.")
        row = WebhookRow(
            id=new_id("whk"),
            url=request.url,
            events=request.events,
            description=request.description,
            secret=new_secret(),
            enabled=True,
            created_at=tx.now,
        )
        tx.session.add(row)
        tx.session.flush()
        return _with_secret(row)


def shown_again(services: Services, webhook_id: str) -> NewWebhook:
    """The answer of a request that was cut off after it had made a webhook. NotFound."""
    with services.catalog.reading() as session:
        return _with_secret(webhooks.get(session, webhook_id))


def page(services: Services, limit: int, cursor: str | None) -> WebhookPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = webhooks.page(session, limit=limit + 1, before=cursor)
    shown, following = cut(rows, limit)
    return WebhookPage(items=[Webhook.of(row) for row in shown], next=following)


def get(services: Services, webhook_id: str) -> Webhook:
    """One webhook. NotFound."""
    with services.catalog.reading() as session:
        return Webhook.of(webhooks.get(session, webhook_id))


def change(services: Services, webhook_id: str, request: WebhookChange) -> Webhook:
    """Change what the request names; a new URL has been admitted. NotFound."""
    with services.catalog.transaction() as tx:
        row = webhooks.lock(tx.session, webhook_id)
        for name in ("url", "events", "description"):
            if (value := getattr(request, name)) is not None:
                setattr(row, name, value)
        if request.enabled is True:
            deliveries.enable(row)
        elif request.enabled is False:
            deliveries.disable(tx, row, "on request")
        return Webhook.of(row)


def delete(services: Services, webhook_id: str) -> None:
    """Forget a webhook and its deliveries. NotFound."""
    deliveries.forget(services.catalog, webhook_id)


def rotate(services: Services, webhook_id: str, overlap_seconds: int) -> NewWebhook:
    """Give a webhook a new secret; for a while the old one signs too. NotFound."""
    with services.catalog.transaction() as tx:
        row = webhooks.lock(tx.session, webhook_id)
        if overlap_seconds:
            row.previous_secret, row.previous_until = row.secret, tx.now + timedelta(seconds=overlap_seconds)
        else:
            row.previous_secret = row.previous_until = None
        row.secret = new_secret()
        note_result(tx.session, "webhooks", webhook_id)
        return _with_secret(row)


def test(services: Services, webhook_id: str) -> Delivery:
    """Send a message that says nothing. NotFound, Conflict where the webhook is switched off."""
    with services.catalog.transaction() as tx:
        return Delivery.of(deliveries.ping(tx, webhooks.lock(tx.session, webhook_id)))


def log(
    services: Services, webhook_id: str, limit: int, cursor: str | None, state: DeliveryState | None
) -> DeliveryPage:
    """One page of a webhook's deliveries, newest first. NotFound."""
    with services.catalog.reading() as session:
        webhooks.get(session, webhook_id)
        rows = webhooks.deliveries(session, webhook_id, limit=limit + 1, before=cursor, state=state)
    shown, following = cut(rows, limit)
    return DeliveryPage(items=[Delivery.of(row) for row in shown], next=following)


def replay(services: Services, webhook_id: str, delivery_id: str) -> Delivery:
    """Make one delivery again, under its old message id. NotFound, Conflict while it is being made."""
    with services.catalog.transaction() as tx:
        hook = webhooks.lock(tx.session, webhook_id)
        row = webhooks.delivery(tx.session, webhook_id, delivery_id)
        if not deliveries.replay(tx, hook, [row]):
            what, remedy = "The delivery is being made at this moment.", "Wait for its end."
            raise conflict("in-flight", "In flight", what, where="path", remedy=remedy)
        return Delivery.of(row)


def replay_failed(services: Services, webhook_id: str, since: datetime) -> Replayed:
    """Make all failed deliveries since a date again. NotFound, Conflict where the webhook is switched off."""
    return Replayed(count=deliveries.replay_failed(services.catalog, webhook_id, since))


def _with_secret(row: WebhookRow) -> NewWebhook:
    return NewWebhook.model_validate({**Webhook.fields_of(row), "secret": row.secret})
