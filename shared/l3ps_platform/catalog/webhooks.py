"""Queries for webhooks and their deliveries."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import ColumnElement, and_, delete, exists, func, or_, select, update
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


@dataclass(frozen=True, slots=True)
class Waiting:
    """A webhook that has something to deliver, or to give up because it is off; ``slow`` where it timed out last."""

    id: str
    project_id: str
    slow: bool


@dataclass(frozen=True, slots=True)
class Flight:
    """How many deliveries of a webhook one deliverer is making now."""

    webhook_id: str
    project_id: str
    owner: str
    count: int


def waiting(session: Session, now: datetime) -> list[Waiting]:
    """The webhooks whose turn could come now, the one whose last turn is longest ago first."""
    row = WebhookRow
    last = func.coalesce(row.attempted_at, row.created_at)
    query = select(row.id, row.project_id, row.paused_until).where(*_could_come(now)).order_by(last, row.id)
    return [Waiting(id, project_id, paused is not None) for id, project_id, paused in session.execute(query)]


def any_waiting(session: Session, now: datetime) -> bool:
    """Whether there is one."""
    return session.scalar(select(WebhookRow.id).where(*_could_come(now)).limit(1)) is not None


def due(session: Session, webhook_id: str, now: datetime, limit: int) -> list[DeliveryRow]:
    """What one webhook is to be sent now, the longest waiting first."""
    query = select(DeliveryRow).where(DeliveryRow.webhook_id == webhook_id, DeliveryRow.next_at <= now, *_free(now))
    return list(session.scalars(query.order_by(DeliveryRow.next_at, DeliveryRow.id).limit(limit)))


def in_flight(session: Session, now: datetime) -> list[Flight]:
    """What is being delivered now."""
    row = DeliveryRow
    query = select(row.webhook_id, row.project_id, row.lease_owner, func.count()).where(
        row.state == DeliveryState.PENDING, row.lease_until >= now
    )
    found = session.execute(query.group_by(row.webhook_id, row.project_id, row.lease_owner))
    return [Flight(webhook_id, project_id, owner or "", count) for webhook_id, project_id, owner, count in found]


def give_up(session: Session, webhook_id: str, now: datetime, error: str, limit: int) -> int:
    """Fail what waits for a webhook and nobody holds, the oldest first; how many."""
    some = select(DeliveryRow.id).where(DeliveryRow.webhook_id == webhook_id, *_free(now)).limit(limit)
    failed = update(DeliveryRow).where(DeliveryRow.id.in_(some.order_by(DeliveryRow.id)))
    values = {"state": DeliveryState.FAILED, "last_error": error, "lease_owner": None, "lease_until": None}
    return len(session.scalars(failed.values(values).returning(DeliveryRow.id)).all())


def revive(session: Session, webhook_id: str, now: datetime, since: datetime, after: str, limit: int) -> list[str]:
    """Have failed deliveries of what happened since a date made again; ids of the next ones after the id ``after``."""
    row = DeliveryRow
    some = select(row.id).where(row.webhook_id == webhook_id, row.state == DeliveryState.FAILED)
    some = some.where(row.created_at >= since, row.lease_owner.is_(None), row.id > after)
    again = update(row).where(row.id.in_(some.order_by(row.id).limit(limit)))
    values = {"state": DeliveryState.PENDING, "attempt": 0, "next_at": now, "delivered_at": None}
    return sorted(session.scalars(again.values(values).returning(row.id)))


def forget_deliveries(session: Session, webhook_id: str, limit: int) -> int:
    """Delete deliveries of a webhook; how many."""
    some = select(DeliveryRow.id).where(DeliveryRow.webhook_id == webhook_id).limit(limit)
    gone = delete(DeliveryRow).where(DeliveryRow.id.in_(some)).returning(DeliveryRow.id)
    return len(session.scalars(gone).all())


def prune_deliveries(session: Session, before: datetime) -> None:
    """Forget deliveries that are over and older than a date."""
    over = (DeliveryRow.state != DeliveryState.PENDING, DeliveryRow.created_at < before)
    session.execute(delete(DeliveryRow).where(*over))


def _free(now: datetime) -> tuple[ColumnElement[bool], ...]:
    unheld = or_(DeliveryRow.lease_until.is_(None), DeliveryRow.lease_until < now)
    return DeliveryRow.state == DeliveryState.PENDING, unheld


def _could_come(now: datetime) -> tuple[ColumnElement[bool], ...]:
    # A probe of the index for each webhook, and not a look at all that waits, which may be a backlog of days.
    due = exists().where(DeliveryRow.webhook_id == WebhookRow.id, *_free(now))
    on = and_(
        due.where(DeliveryRow.next_at <= now), or_(WebhookRow.paused_until.is_(None), WebhookRow.paused_until <= now)
    )
    return (or_(on, and_(WebhookRow.enabled.is_(False), due)),)
