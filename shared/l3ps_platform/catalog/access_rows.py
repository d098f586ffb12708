"""The tables of API keys and of answers kept for repeated requests."""

from __future__ import annotations

from datetime import datetime
from typing import ClassVar

from sqlalchemy import ForeignKey, Index, LargeBinary, String
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Json, Owned


class ApiKeyRow(Owned, Base):
    """A key to one project. Its secret is shown once and kept as a SHA-256 alone.

    ``previous_sha256`` is the secret's before the last rotation, good until ``previous_until``. ``last_used_at`` is
    written at most once a minute.
    """

    __tablename__ = "api_keys"
    __table_args__ = (Index(None, "project_id", "id"),)
    noun: ClassVar[str] = "key"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    scope: Mapped[str] = mapped_column(String(16))  # read | write | admin
    secret_sha256: Mapped[str] = mapped_column(String(64))
    previous_sha256: Mapped[str | None] = mapped_column(String(64))
    previous_until: Mapped[datetime | None]
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]


class RequestRow(Owned, Base):
    """A POST that carried an Idempotency-Key, and its answer.

    Until ``status`` is there, the request is in progress and belongs to ``owner`` until ``lease_until``.
    ``result_kind`` and ``result_id`` name the resource it made (``jobs``, ``job_…``): written in the transaction that
    made it, so that whoever comes after a crash finds either both or neither. ``body`` is None for an answer that was
    too large to keep.
    """

    __tablename__ = "requests"
    __table_args__ = (Index(None, "expires_at"),)
    noun: ClassVar[str] = "request"

    project_id: Mapped[str] = mapped_column(String(32), ForeignKey("projects.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))  # SHA-256 of method, path, query and body
    owner: Mapped[str] = mapped_column(String(32))
    lease_until: Mapped[datetime]
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    status: Mapped[int | None]
    headers: Mapped[Json | None]
    body: Mapped[bytes | None] = mapped_column(LargeBinary)
    result_kind: Mapped[str | None] = mapped_column(String(32))
    result_id: Mapped[str | None] = mapped_column(String(64))
