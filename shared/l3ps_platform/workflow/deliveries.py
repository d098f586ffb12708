"""Webhooks' deliveries: who makes one, how it ended, and what a webhook that takes nothing comes to.

A delivery belongs to its deliverer for the length of a lease; one whose deliverer died is made again, with the same
message id (at least once). The webhook's row is held before its deliveries are changed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice
from typing import TypeVar

from sqlalchemy import update

from l3ps_platform.catalog import webhooks
from l3ps_platform.catalog.event_rows import DeliveryRow, WebhookRow
from l3ps_platform.catalog.kinds import PING, EventKind
from l3ps_platform.catalog.outbox import delivery
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.catalog.states import DeliveryState
from l3ps_platform.errors import Conflict, NotFound

PER_WEBHOOK = 4
"""Deliveries that one webhook is sent at a time, by all processes together."""

KEPT_ATTEMPTS = 20
"""Of a delivery's attempts, those its log remembers."""

LONGEST_PAUSE = timedelta(minutes=10)
"""A webhook that lets attempts time out is left alone for as long as it has been failing, at most so long: each holds a
place for the whole time that an attempt may take."""

BATCH = 1000
"""Deliveries changed in one transaction: SQLite has one writer, and the backlog of a webhook may be of days."""

T = TypeVar("T")


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
        timed_out: the receiver held it up to the end of its time.
    """

    status: int | None
    error: str | None
    seconds: float
    again_after: timedelta | None = None
    gone: bool = False
    timed_out: bool = False


def take(tx: Transaction, owner: str, *, limit: int, share: int, lease_seconds: float) -> list[Parcel]:
    """Claim deliveries that are due, fairly between projects and between the webhooks of each.

    Each gets one before any gets its second, projects with the fewest under way and webhooks whose last turn is longest
    ago first. So receivers that hang hold up neither others nor, with places to spare, their own project.

    Args:
        tx: the transaction.
        owner: who is to hold them.
        limit: how many at most.
        share: of those the owner holds, how many may be one project's.
        lease_seconds: for how long.
    """
    flying = _Flying(tx, owner)
    hooks_of: dict[str, list[str]] = {}
    for hook in webhooks.waiting(tx.session, tx.now):
        if flying.room(hook.id, slow=hook.slow) > 0 and flying.mine[hook.project_id] < share:
            hooks_of.setdefault(hook.project_id, []).append(hook.id)
    projects = sorted(hooks_of, key=lambda project: flying.of_project[project])
    chosen = list(islice(in_turn(hooks_of[project] for project in projects), limit))
    # Held in the order of their ids, so that two who claim at once do not wait for each other.
    held: dict[str, WebhookRow] = {}
    for id in sorted(chosen):
        with suppress(NotFound):  # deleted in this moment
            held[id] = webhooks.lock(tx.session, id)
    flying = _Flying(tx, owner)
    queues: dict[str, list[list[tuple[WebhookRow, DeliveryRow]]]] = {project: [] for project in projects}
    for row in (held[id] for id in chosen if id in held):
        room = flying.room(row.id, slow=row.paused_until is not None)
        if not row.enabled:
            row.attempted_at = tx.now
            _give_up(tx, row)  # too many to be given up at once, or held then by a deliverer that died
        elif room > 0:
            due = webhooks.due(tx.session, row.id, tx.now, room)
            queues[row.project_id].append([(row, delivery) for delivery in due])
    shares = [islice(in_turn(queues[project]), max(share - flying.mine[project], 0)) for project in projects]
    parcels = []
    for hook_row, delivery_row in islice(in_turn(shares), limit):
        hook_row.attempted_at = tx.now
        delivery_row.lease_owner, delivery_row.lease_until = owner, tx.now + timedelta(seconds=lease_seconds)
        parcels.append(_parcel(tx, hook_row, delivery_row, owner))
    tx.session.flush()
    return parcels


def _parcel(tx: Transaction, hook: WebhookRow, row: DeliveryRow, owner: str) -> Parcel:
    secrets = signing_secrets(hook, tx.now)
    return Parcel(row.id, hook.id, owner, hook.url, secrets, row.body.encode(), row.attempt)


def in_turn(queues: Iterable[Iterable[T]]) -> Iterator[T]:
    """The first of each, then the second of each, and so on."""
    left = [iter(queue) for queue in queues]
    while left:
        waiting, left = left, []
        for queue in waiting:
            for item in islice(queue, 1):
                yield item
                left.append(queue)


class _Flying:
    """What is under way: of each webhook and project by all deliverers, of each project by this one."""

    def __init__(self, tx: Transaction, owner: str) -> None:
        self._of_hook: Counter[str] = Counter()
        self.of_project: Counter[str] = Counter()
        self.mine: Counter[str] = Counter()
        for flight in webhooks.in_flight(tx.session, tx.now):
            self._of_hook[flight.webhook_id] += flight.count
            self.of_project[flight.project_id] += flight.count
            self.mine[flight.project_id] += flight.count if flight.owner == owner else 0

    def room(self, webhook_id: str, *, slow: bool) -> int:
        """How many more a webhook may be sent; one that timed out is tried with one."""
        return (1 if slow else PER_WEBHOOK) - self._of_hook[webhook_id]


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
        hook.failing_since = hook.paused_until = None
        return
    hook.failing_since = hook.failing_since or tx.now
    pause = max(tx.now - hook.failing_since, timedelta(seconds=attempt.seconds))
    hook.paused_until = tx.now + min(pause, LONGEST_PAUSE) if attempt.timed_out else None
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
    for parcel in sorted(parcels, key=lambda parcel: (parcel.webhook_id, parcel.id)):
        with suppress(NotFound):  # deleted meanwhile
            webhooks.lock(tx.session, parcel.webhook_id)
            mine = (DeliveryRow.id == parcel.id, DeliveryRow.lease_owner == parcel.owner)
            tx.session.execute(update(DeliveryRow).where(*mine).values(lease_owner=None, lease_until=None))


def disable(tx: Transaction, hook: WebhookRow, reason: str) -> None:
    """Switch a webhook off; what waits for it has failed and can be replayed. The caller holds its row.

    Beyond a first batch the deliverers see to that.
    """
    if not hook.enabled:
        return
    hook.enabled, hook.disabled_reason = False, reason
    tx.session.flush()
    _give_up(tx, hook)
    # Without the URL, which often holds a secret: whoever may read, and every other webhook's receiver, is told this.
    tx.emit(EventKind.WEBHOOK_DISABLED, hook, {"id": hook.id, "reason": reason})


def _give_up(tx: Transaction, hook: WebhookRow) -> None:
    webhooks.give_up(tx.session, hook.id, tx.now, f"the webhook was switched off: {hook.disabled_reason}", BATCH)


def forget(catalog: Catalog, id: str) -> None:
    """Delete a webhook and its deliveries. NotFound.

    In portions: whoever writes an event holds a lock that all who do so need, and waits for a webhook's row that is
    being deleted. It is switched off first, so that no more deliveries are made for it.
    """
    with catalog.transaction() as tx:
        webhooks.lock(tx.session, id).enabled = False
    left = True
    while left:
        with catalog.transaction() as tx:
            left = bool(webhooks.forget_deliveries(tx.session, id, BATCH))
    with catalog.transaction() as tx, suppress(NotFound):  # somebody else did it meanwhile
        tx.session.delete(webhooks.get(tx.session, id))


def enable(hook: WebhookRow) -> None:
    """Switch a webhook on again, with a clean record."""
    hook.enabled, hook.disabled_reason, hook.failing_since, hook.paused_until = True, None, None, None


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


def replay_failed(catalog: Catalog, id: str, since: datetime) -> int:
    """Have all failed deliveries of what happened since a date made again; how many.

    NotFound; Conflict where the webhook is switched off. A batch a transaction, the oldest first.
    """
    count, last = 0, ""
    while True:
        with catalog.transaction() as tx:
            must_be_enabled(webhooks.lock(tx.session, id))
            found = webhooks.revive(tx.session, id, tx.now, since, last, BATCH)
        if not found:
            return count
        count, last = count + len(found), found[-1]


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
