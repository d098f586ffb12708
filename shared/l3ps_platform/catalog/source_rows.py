"""Rows of what arrives by itself: rules, and the objects that met one."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey, Index, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Json, Owned


class RuleRow(Owned, Base):
    """What becomes of an object that arrives in a bucket.

    ``settings`` are those of the job: ``{"model", "preset", "segment", "formats", "protocol", "skip_bad_scans"}``.
    """

    __tablename__ = "rules"
    noun = "rule"
    __table_args__ = (
        UniqueConstraint("project_id", "name"),
        Index(None, "project_id", "id"),
        Index(None, "bucket"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    bucket: Mapped[str] = mapped_column(String(63))
    prefix: Mapped[str]  # without slashes at its ends; "" for the whole bucket
    suffix: Mapped[str | None]
    settings: Mapped[Json]
    created_at: Mapped[datetime]


class ArrivalRow(Owned, Base):
    """An object that met a rule, once for each time it was written, however often that was told.

    ``digest`` is over bucket, key, etag and sequencer. Until ``settled_at`` it waits to become a job; then it has one,
    or ``error``: ``{"message", "problems": […]}``.
    """

    __tablename__ = "arrivals"
    noun = "arrival"
    __table_args__ = (
        UniqueConstraint("rule_id", "digest"),
        Index(None, "settled_at"),
        Index(None, "rule_id", "id"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    rule_id: Mapped[str] = mapped_column(ForeignKey("rules.id", ondelete="CASCADE"))
    digest: Mapped[str] = mapped_column(String(64))
    key: Mapped[str]
    source: Mapped[str]  # s3://bucket/prefix of the log
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="SET NULL"))
    error: Mapped[Json | None]
    created_at: Mapped[datetime]
    settled_at: Mapped[datetime | None]
