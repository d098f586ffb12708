"""Webhooks and their deliveries as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from l3ps_api.moments import Moment
from l3ps_platform.catalog import DeliveryRow, DeliveryState, EventKind, WebhookRow
from l3ps_platform.catalog.kinds import select_kinds


def _known(pattern: str) -> str:
    select_kinds([pattern])
    return pattern


_kinds = f"{', '.join(EventKind)}; groups such as `job.*`. None: all of them."
Patterns = Annotated[list[Annotated[str, AfterValidator(_known)]], Field(max_length=40, description=_kinds)]
_PRINTABLE = r"^[^\x00-\x1f\x7f]*$"
Url = Annotated[
    str, Field(max_length=2000, pattern=_PRINTABLE, description="Where to send to: https, and a public address.")
]
Text = Annotated[str, Field(max_length=200, pattern=_PRINTABLE)]


class WebhookRequest(BaseModel):
    """Whom to tell of what."""

    model_config = ConfigDict(extra="forbid")

    url: Url
    events: Patterns = Field(default_factory=list)
    description: Text = ""


class WebhookChange(BaseModel):
    """What to change; what is left out stays."""

    model_config = ConfigDict(extra="forbid")

    url: Url | None = None
    events: Patterns | None = None
    description: Text | None = None
    enabled: bool | None = Field(
        default=None, description="Switching off fails what waits; switching on forgets earlier failures."
    )


class Rotation(BaseModel):
    model_config = ConfigDict(extra="forbid")

    overlap_seconds: int = Field(
        default=24 * 3600, ge=0, le=30 * 24 * 3600, description="How long the old secret signs beside the new one."
    )


class ReplayRequest(BaseModel):
    model_config = ConfigDict(extra="forbid")

    since: Moment = Field(description="Replay what failed of that which happened since then.")


class Replayed(BaseModel):
    count: int = Field(description="How many deliveries will be made again.")


class Webhook(BaseModel):
    id: str
    url: str
    events: list[str]
    description: str
    enabled: bool
    disabled_reason: str | None = Field(description="Why the service switched it off, if it did.")
    failing_since: datetime | None = Field(description="First of the failures since which nothing was delivered.")
    previous_secret_until: datetime | None = Field(description="Until when the secret before the last rotation signs.")
    created_at: datetime

    @classmethod
    def fields_of(cls, row: WebhookRow) -> dict[str, object]:
        """The fields from the row."""
        kept = ("id", "url", "events", "description", "enabled", "disabled_reason", "failing_since", "created_at")
        return {**{name: getattr(row, name) for name in kept}, "previous_secret_until": row.previous_until}

    @classmethod
    def of(cls, row: WebhookRow) -> Webhook:
        """From the row."""
        return cls.model_validate(cls.fields_of(row))


class NewWebhook(Webhook):
    """A webhook with its secret, which is shown here and never again."""

    secret: str = Field(description="What messages are signed with: Standard Webhooks, `whsec_` and base64.")


class WebhookPage(BaseModel):
    items: list[Webhook]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")


class DeliveryAttempt(BaseModel):
    at: datetime
    status: int | None = Field(description="Of the HTTP answer, if there was one.")
    error: str | None
    seconds: float


class Delivery(BaseModel):
    """One message to one webhook; `id` is its `webhook-id`, the same at every attempt."""

    id: str
    webhook_id: str
    type: str
    seq: int | None = Field(description="Number of the event; none for a test.")
    state: DeliveryState
    attempts: int = Field(description="How many were made, since the last replay.")
    next_at: datetime | None = Field(description="When the next attempt is due.")
    last_status: int | None
    last_error: str | None
    created_at: datetime
    delivered_at: datetime | None
    body: str = Field(description="The message, exactly as signed and sent.")
    log: list[DeliveryAttempt] = Field(description="The latest attempts.")

    @classmethod
    def of(cls, row: DeliveryRow) -> Delivery:
        """From the row."""
        same = (
            "id",
            "webhook_id",
            "seq",
            "state",
            "last_status",
            "last_error",
            "created_at",
            "delivered_at",
            "body",
            "log",
        )
        fields = {name: getattr(row, name) for name in (*same, "body", "log")}
        due = row.next_at if row.state is DeliveryState.PENDING else None
        return cls.model_validate({**fields, "type": row.kind, "attempts": row.attempt, "next_at": due})


class DeliveryPage(BaseModel):
    items: list[Delivery]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")
