"""What leaves with a transaction: its events, and the deliveries they mean for webhooks.

Both are rows of the same transaction as the change they tell of, so neither can be lost or invented: there is no step
between "it happened" and "it is to be told" in which a process could die. The price is one query more for a transaction
in which something happened.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from l3ps_platform.catalog.base import Json, Owned
from l3ps_platform.catalog.event_rows import DeliveryRow, EventRow, WebhookRow
from l3ps_platform.catalog.kinds import EventKind, wanted
from l3ps_platform.catalog.states import DeliveryState
from l3ps_platform.ids import new_id

_ORDER = 7_335_402  # any constant of ours: who holds it is the only one who numbers events


@dataclass(frozen=True, slots=True)
class Happening:
    """An event before it has a number: its kind, the row it happened to, and what there is to say."""

    kind: EventKind
    subject: Owned
    data: Json


def write(session: Session, happenings: Sequence[Happening], now: datetime) -> None:
    """Add the events of a transaction to the log and make their deliveries; to be called last before the commit."""
    session.flush()
    if session.get_bind().dialect.name == "postgresql":
        # Numbers are given here and become visible at the commit. Without order between the two a reader that has seen
        # 7 would never look at the 6 that is committed after it. All other locks are held already, so this is the
        # last; SQLite has one writer anyway.
        session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _ORDER})
    events = [
        EventRow(
            project_id=happening.subject.project_id,
            kind=happening.kind.value,
            subject_id=happening.subject.id,  # type: ignore[attr-defined]
            data=happening.data,
            created_at=now,
        )
        for happening in happenings
    ]
    for event in events:  # one by one: the numbers follow the order in which things happened
        session.add(event)
        session.flush()
    projects = {event.project_id for event in events}
    # Held, or a webhook deleted in this moment would break the deliveries' foreign key and with it the transaction.
    hooks = select(WebhookRow).where(WebhookRow.project_id.in_(projects), WebhookRow.enabled.is_(True))
    for hook in session.scalars(hooks.order_by(WebhookRow.id).with_for_update(read=True, key_share=True)):
        for event in events:
            if event.project_id == hook.project_id and wanted(hook.events, event.kind):
                session.add(delivery(hook, event.kind, event.data, now, seq=event.seq))
    session.flush()


def delivery(hook: WebhookRow, kind: str, data: Json, now: datetime, *, seq: int | None = None) -> DeliveryRow:
    """A message to a webhook, due at once."""
    message = {"type": kind, "timestamp": now.isoformat().replace("+00:00", "Z"), "data": data}
    return DeliveryRow(
        id=new_id("msg"),
        project_id=hook.project_id,
        webhook_id=hook.id,
        seq=seq,
        kind=kind,
        body=json.dumps(message, ensure_ascii=False, separators=(",", ":")),
        state=DeliveryState.PENDING,
        attempt=0,
        next_at=now,
        log=[],
        created_at=now,
    )
