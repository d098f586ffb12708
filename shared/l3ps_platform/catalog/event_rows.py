"""The tables of what happened and of who is told: the event log, webhooks and their deliveries."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, String, Text
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Json, Owned
from l3ps_platform.catalog.states import DeliveryState

_LIST = JSON().with_variant(JSONB(), "postgresql")


class EventRow(Owned, Base):
    """Something that happened, written in the transaction in which it did.

    ``seq`` grows in the order of the commits, so whoever has seen a number has seen all below it. ``subject_id`` names
    the job, drive, model, training or webhook; what happens to a scene or stage of a job has the job as its subject.
    """

    __tablename__ = "events"
    noun = "event"
    __table_args__ = (
        Index(None, "project_id", "seq"),
        Index(None, "subject_id", "seq"),
        Index(None, "created_at"),
        {"sqlite_autoincrement": True},  # without it the number of the last row, once pruned, is given again
    )

    seq: Mapped[int] = mapped_column(BigInteger().with_variant(Integer(), "sqlite"), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    subject_id: Mapped[str] = mapped_column(String(32))
    data: Mapped[Json]
    created_at: Mapped[datetime]


class WebhookRow(Owned, Base):
    """A URL that is told of events.

    ``events``: kinds and groups of them, empty for all. ``previous_secret`` signs too until ``previous_until``.
    ``failing_since``: the first of the failures since which nothing was delivered. ``attempted_at``: when its last turn
    began. ``paused_until``: it let the last attempt time out, and is left alone until then.
    """

    __tablename__ = "webhooks"
    noun = "webhook"
    __table_args__ = (Index(None, "project_id", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    url: Mapped[str]
    events: Mapped[list[str]] = mapped_column(_LIST)
    description: Mapped[str] = mapped_column(String(200), default="")
    secret: Mapped[str] = mapped_column(String(128))
    previous_secret: Mapped[str | None] = mapped_column(String(128))
    previous_until: Mapped[datetime | None]
    enabled: Mapped[bool] = mapped_column(default=True)
    disabled_reason: Mapped[str | None]
    failing_since: Mapped[datetime | None]
    attempted_at: Mapped[datetime | None]
    paused_until: Mapped[datetime | None]
    created_at: Mapped[datetime]


class DeliveryRow(Owned, Base):
    """One message to one webhook; its id is the message's, the same at every attempt.

    ``seq`` is the event's, None for a test. There is no foreign key to the event: the message is complete, and outlives
    the event in the log. ``attempt`` counts those that were made. ``log`` holds the last of them:
    ``{"at", "status", "error", "seconds"}``.
    """

    __tablename__ = "deliveries"
    noun = "delivery"
    __table_args__ = (
        Index(None, "webhook_id", "id"),
        Index(None, "webhook_id", "state", "next_at"),
        Index(None, "state", "next_at"),
        Index(None, "lease_until"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    seq: Mapped[int | None]
    kind: Mapped[str] = mapped_column(String(32))
    body: Mapped[str] = mapped_column(Text)
    state: Mapped[DeliveryState] = mapped_column(default=DeliveryState.PENDING)
    attempt: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime]
    lease_owner: Mapped[str | None] = mapped_column(String(64))
    lease_until: Mapped[datetime | None]
    last_status: Mapped[int | None]
    last_error: Mapped[str | None]
    log: Mapped[list[Any]] = mapped_column(_LIST)
    created_at: Mapped[datetime]
    delivered_at: Mapped[datetime | None]
