"""Webhooks' deliveries: who makes one, how it ended, and what a webhook that takes nothing comes to.

A delivery belongs to its deliverer for the length of a lease; one whose deliverer died is made again, with the same
message id (at least once). The webhook's row is held before its deliveries are changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import chain, zip_longest

from sqlalchemy import select, update

from l3ps_platform.catalog import webhooks
from l3ps_platform.catalog.event_rows import DeliveryRow, WebhookRow
from l3ps_platform.catalog.kinds import PING, EventKind
from l3ps_platform.catalog.outbox import delivery
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import DeliveryState
from l3ps_platform.errors import Conflict, NotFound

PER_WEBHOOK = 4
"""Deliveries that one webhook is sent at a time, by all processes together."""

KEPT_ATTEMPTS = 20
"""Of a delivery's attempts, those its log remembers."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """A delivery in this process' hands.

    Attributes:
        id: the message's.
        webhook_id: where it goes.
        owner: who holds it.
        url: of the webhook.
        secrets: to sign with, the newest first.
        body: what to send.
        attempts: how many were made before.
    """

    id: str
    webhook_id: str
    owner: str
    url: str
    secrets: tuple[str, ...]
    body: bytes
    attempts: int


@dataclass(frozen=True, slots=True)
class Attempt:
    """How one ended.

    Attributes:
        status: of the HTTP answer, if there was one.
        error: what went wrong; None when the message was taken.
        seconds: what it took.
        again_after: how long to wait before the next one; None: there is none.
        gone: the receiver wants no more messages.
    """

    status: int | None
    error: str | None
    seconds: float
    again_after: timedelta | None = None
    gone: bool = False


def take(tx: Transaction, owner: str, *, limit: int, lease_seconds: float) -> list[Parcel]:
    """Claim deliveries that are due, fairly between webhooks: each gets one before any gets its second.

    Args:
        tx: the transaction.
        owner: who is to hold them.
        limit: how many at most.
        lease_seconds: for how long.
    """
    queues: list[list[tuple[WebhookRow, DeliveryRow]]] = []
    chosen = webhooks.with_due(tx.session, tx.now)
    # Held in the order of their ids, so that two who claim at once do not wait for each other.
    hooks: dict[str, WebhookRow] = {}
    for id in sorted(chosen):
        with suppress(NotFound):  # deleted in this moment
            hooks[id] = webhooks.lock(tx.session, id)
    busy = webhooks.in_flight(tx.session, chosen, tx.now)
    for hook in (hooks[id] for id in chosen if id in hooks):
        free = PER_WEBHOOK - busy.get(hook.id, 0)
        rows = webhooks.due(tx.session, hook.id, tx.now, free) if free > 0 else []
        if hook.enabled:
            queues.append([(hook, row) for row in rows])
        else:
            _give_up(rows, hook)  # held when it was switched off, by a deliverer that died
    in_turn: Iterable[tuple[WebhookRow, DeliveryRow] | None] = chain.from_iterable(zip_longest(*queues))
    parcels = []
    for hook, row in [pair for pair in in_turn if pair is not None][:limit]:
        row.lease_owner, row.lease_until = owner, tx.now + timedelta(seconds=lease_seconds)
        body = row.body.encode()
        parcels.append(Parcel(row.id, hook.id, owner, hook.url, signing_secrets(hook, tx.now), body, row.attempt))
    tx.session.flush()
    return parcels


def signing_secrets(hook: WebhookRow, now: datetime) -> tuple[str, ...]:
    """The secrets that a webhook's messages are signed with now."""
    old = hook.previous_secret
    overlapping = old is not None and hook.previous_until is not None and hook.previous_until > now
    return (hook.secret, old) if overlapping and old is not None else (hook.secret,)


def attempted(tx: Transaction, parcel: Parcel, attempt: Attempt, *, disable_after: timedelta) -> None:
    """Record an attempt and what follows; nothing where the delivery is no longer this owner's. NotFound.

    Args:
        tx: the transaction.
        parcel: the delivery.
        attempt: how it ended.
        disable_after: a webhook that took nothing for so long is switched off.
    """
    hook = webhooks.lock(tx.session, parcel.webhook_id)
    row = webhooks.delivery(tx.session, hook.id, parcel.id)
    if row.lease_owner != parcel.owner or row.state is not DeliveryState.PENDING:
        return
    row.lease_owner = row.lease_until = None
    row.attempt += 1
    row.last_status, row.last_error = attempt.status, attempt.error
    entry = {"at": tx.now.isoformat(), "status": attempt.status, "error": attempt.error}
    row.log = [*row.log, {**entry, "seconds": round(attempt.seconds, 3)}][-KEPT_ATTEMPTS:]
    if attempt.error is None:
        row.state, row.delivered_at = DeliveryState.DELIVERED, tx.now
        hook.failing_since = None
        return
    hook.failing_since = hook.failing_since or tx.now
    if attempt.again_after is None or attempt.gone or not hook.enabled:
        row.state = DeliveryState.FAILED
    else:
        row.next_at = tx.now + attempt.again_after
    if attempt.gone:
        disable(tx, hook, "the receiver answered 410: it wants no more messages")
    elif tx.now - hook.failing_since >= disable_after:
        disable(tx, hook, f"nothing was delivered since {hook.failing_since:%Y-%m-%d %H:%M} UTC")


def put_back(tx: Transaction, parcels: Sequence[Parcel]) -> None:
    """Let others make deliveries that were claimed and not attempted."""
    for parcel in sorted(parcels, key=lambda parcel: parcel.webhook_id):
        mine = (DeliveryRow.id == parcel.id, DeliveryRow.lease_owner == parcel.owner)
        tx.session.execute(update(DeliveryRow).where(*mine).values(lease_owner=None, lease_until=None))


def disable(tx: Transaction, hook: WebhookRow, reason: str) -> None:
    """Switch a webhook off; what waits for it has failed and can be replayed. The caller holds its row."""
    if not hook.enabled:
        return
    hook.enabled, hook.disabled_reason = False, reason
    waiting = select(DeliveryRow).where(
        DeliveryRow.webhook_id == hook.id, DeliveryRow.state == DeliveryState.PENDING, DeliveryRow.lease_owner.is_(None)
    )
    _give_up(tx.session.scalars(waiting), hook)
    tx.session.flush()
    # Without the URL, which often holds a secret: whoever may read, and every other webhook's receiver, is told this.
    tx.emit(EventKind.WEBHOOK_DISABLED, hook, {"id": hook.id, "reason": reason})


def _give_up(rows: Iterable[DeliveryRow], hook: WebhookRow) -> None:
    for row in rows:
        row.state, row.last_error = DeliveryState.FAILED, f"the webhook was switched off: {hook.disabled_reason}"
        row.lease_owner = row.lease_until = None


def enable(hook: WebhookRow) -> None:
    """Switch a webhook on again, with a clean record."""
    hook.enabled, hook.disabled_reason, hook.failing_since = True, None, None


def replay(tx: Transaction, hook: WebhookRow, rows: Iterable[DeliveryRow]) -> int:
    """Have deliveries made once more, from the start of the schedule; how many. The caller holds the webhook's row.

    Conflict where the webhook is switched off.
    """
    must_be_enabled(hook)
    count = 0
    for row in rows:
        if row.lease_owner is None:
            row.state, row.attempt, row.next_at, row.delivered_at = DeliveryState.PENDING, 0, tx.now, None
            count += 1
    tx.session.flush()
    return count


def ping(tx: Transaction, hook: WebhookRow) -> DeliveryRow:
    """A delivery that says nothing, to try the receiver with. Conflict where the webhook is switched off."""
    must_be_enabled(hook)
    row = delivery(hook, PING, {"id": hook.id, "url": hook.url}, tx.now)
    tx.session.add(row)
    tx.session.flush()
    return row


def must_be_enabled(hook: WebhookRow) -> None:
    """Conflict unless a webhook is switched on."""
    if not hook.enabled:
        raise Conflict(f"webhook {hook.id} is switched off: switch it on first (PATCH it with enabled: true)")
