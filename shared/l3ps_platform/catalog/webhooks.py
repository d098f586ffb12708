"""Queries for webhooks and their deliveries."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Select, delete, func, or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.event_rows import DeliveryRow, WebhookRow
from l3ps_platform.catalog.states import DeliveryState
from l3ps_platform.errors import NotFound


def get(session: Session, id: str) -> WebhookRow:
    """One webhook. NotFound."""
    return queries.get(session, WebhookRow, id)


def lock(session: Session, id: str) -> WebhookRow:
    """One webhook, held against concurrent changes until the transaction ends; deliveries to it may be made. NotFound.

    Every change of deliveries holds their webhook first.
    """
    # Not FOR UPDATE: that excludes whoever writes an event, who may hold what this transaction wants next.
    query = select(WebhookRow).where(WebhookRow.id == id).with_for_update(key_share=True)
    row = session.scalars(query, execution_options={"populate_existing": True}).one_or_none()
    if row is None:
        raise NotFound("webhook", id)
    return row


def page(session: Session, *, limit: int, before: str | None) -> list[WebhookRow]:
    """Webhooks, newest first, after the cursor ``before`` (the last id of the page before)."""
    return queries.page(session, WebhookRow, limit=limit, before=before)


def count(session: Session) -> int:
    """How many there are."""
    return session.scalar(select(func.count(WebhookRow.id))) or 0


def delivery(session: Session, webhook_id: str, id: str) -> DeliveryRow:
    """One delivery of a webhook, as it is now. NotFound."""
    query = select(DeliveryRow).where(DeliveryRow.id == id, DeliveryRow.webhook_id == webhook_id)
    row = session.scalars(query, execution_options={"populate_existing": True}).one_or_none()
    if row is None:
        raise NotFound("delivery", id)
    return row


def deliveries(
    session: Session, webhook_id: str, *, limit: int, before: str | None, state: DeliveryState | None = None
) -> list[DeliveryRow]:
    """Deliveries of a webhook, newest first, after the cursor ``before``."""
    conditions = [DeliveryRow.webhook_id == webhook_id]
    if state is not None:
        conditions.append(DeliveryRow.state == state)
    return queries.page(session, DeliveryRow, *conditions, limit=limit, before=before)


def failed_since(session: Session, webhook_id: str, since: datetime) -> Sequence[DeliveryRow]:
    """Failed deliveries of what happened since a date, oldest first."""
    query = select(DeliveryRow).where(DeliveryRow.webhook_id == webhook_id, DeliveryRow.state == DeliveryState.FAILED)
    return list(session.scalars(query.where(DeliveryRow.created_at >= since).order_by(DeliveryRow.id)))


def with_due(session: Session, now: datetime, limit: int = 100) -> list[str]:
    """Ids of the webhooks that have something to deliver now, the longest waiting first."""
    query = _due(select(DeliveryRow.webhook_id), now).group_by(DeliveryRow.webhook_id)
    return list(session.scalars(query.order_by(func.min(DeliveryRow.next_at)).limit(limit)))


def due(session: Session, webhook_id: str, now: datetime, limit: int) -> list[DeliveryRow]:
    """What one webhook is to be sent now, the longest waiting first."""
    query = _due(select(DeliveryRow), now).where(DeliveryRow.webhook_id == webhook_id)
    return list(session.scalars(query.order_by(DeliveryRow.next_at, DeliveryRow.id).limit(limit)))


def in_flight(session: Session, webhook_ids: Sequence[str], now: datetime) -> dict[str, int]:
    """How many deliveries of each webhook somebody is making now."""
    query = select(DeliveryRow.webhook_id, func.count()).where(
        DeliveryRow.webhook_id.in_(webhook_ids),
        DeliveryRow.state == DeliveryState.PENDING,
        DeliveryRow.lease_until >= now,
    )
    return dict(session.execute(query.group_by(DeliveryRow.webhook_id)).all())


def prune_deliveries(session: Session, before: datetime) -> None:
    """Forget deliveries that are over and older than a date."""
    over = (DeliveryRow.state != DeliveryState.PENDING, DeliveryRow.created_at < before)
    session.execute(delete(DeliveryRow).where(*over))


def _due(query: Select[Any], now: datetime) -> Select[Any]:
    free = or_(DeliveryRow.lease_until.is_(None), DeliveryRow.lease_until < now)
    return query.where(DeliveryRow.state == DeliveryState.PENDING, DeliveryRow.next_at <= now, free)
