"""Documents of a project itself, as in :mod:`l3ps_client._documents`: who may do what, who is told, what is kept."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

from l3ps_client._documents import Ref


class Me(TypedDict):
    """Who the service takes the caller for."""

    project: Ref
    scope: Literal["read", "write", "admin", "operator"]
    key: Ref | None


class Project(TypedDict):
    """A project: its drives, models and jobs are nobody else's."""

    id: str
    name: str
    created_at: str


class Key(TypedDict):
    """An API key; ``secret`` is there only in the answer that makes or rotates it.

    It is None in the answer to a request that was repeated because its answer was lost: rotate the key then.
    """

    id: str
    name: str
    scope: Literal["read", "write", "admin"]
    created_at: str
    expires_at: NotRequired[str | None]
    revoked_at: NotRequired[str | None]
    last_used_at: NotRequired[str | None]
    previous_until: NotRequired[str | None]
    secret: NotRequired[str | None]


class Webhook(TypedDict):
    """An address that the service tells of events; ``secret`` is there only in the answer that makes or rotates it."""

    id: str
    url: str
    events: list[str]
    description: str
    enabled: bool
    disabled_reason: str | None
    failing_since: str | None
    previous_secret_until: str | None
    created_at: str
    secret: NotRequired[str | None]


class Delivery(TypedDict):
    """One message on its way to a webhook, and how it fared; ``id`` is its ``webhook-id`` at every attempt."""

    id: str
    webhook_id: str
    type: str
    state: Literal["pending", "delivered", "failed"]
    attempts: int
    next_at: str | None
    last_status: int | None
    last_error: str | None
    created_at: str
    delivered_at: str | None
    body: str
    log: list[dict[str, Any]]


class Rule(TypedDict):
    """What turns a log that arrives in a bucket into a job."""

    id: str
    name: str
    bucket: str
    prefix: str
    suffix: NotRequired[str | None]
    model: str
    arrivals: int
    latest: NotRequired[dict[str, Any] | None]
    created_at: str


class Retention(TypedDict):
    """How long and how much a project's finished results are kept; None for no bound."""

    max_age_days: int | None
    max_bytes: int | None
    stored_bytes: NotRequired[int]
