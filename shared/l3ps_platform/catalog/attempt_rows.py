"""What is kept for the metrics: every attempt at a stage that has ended, and the latest figures of every model."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import ClassVar

from sqlalchemy import BigInteger, ForeignKey, Index, Integer, String
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Json, Owned
from l3ps_platform.catalog.states import StageName


class Outcome(StrEnum):
    """How an attempt ended."""

    DONE = "done"
    FAILED = "failed"  # and the stage with it
    RETRIED = "retried"  # it failed, and another attempt follows
    LOST = "lost"  # its worker is gone, and another attempt follows
    RELEASED = "released"  # given back by a worker that stopped; the same attempt begins again elsewhere
    CANCELLED = "cancelled"


class AttemptRow(Owned, Base):
    """One attempt at a stage that has ended. Rows are only added, so that sums over them never go down.

    They outlive their stage, whose row tells of its last attempt alone. An attempt that was given back and begun again
    has a row for each time.

    Attributes:
        started_at, finished_at: by the database's clock.
        cause: why it failed, one of the causes that stages keep in their ``error``; None where it did not fail.
        seconds, cpu_seconds, peak_mb: its cost. Of a worker that is gone only the time between is known.
        scans, points: what was processed, 0 where it brought nothing.
        bytes: what an ingest took in and other stages stored.
        cached: the output was there already.
    """

    __tablename__ = "attempts"
    __table_args__ = (Index(None, "finished_at"), Index(None, "stage_id"))
    noun: ClassVar[str] = "attempt"

    # SQLite numbers rows by itself only where the key is spelled INTEGER.
    id: Mapped[int] = mapped_column(BigInteger().with_variant(Integer(), "sqlite"), primary_key=True)
    stage_id: Mapped[str] = mapped_column(String(32))
    job_id: Mapped[str | None] = mapped_column(String(32))
    name: Mapped[StageName]
    attempt: Mapped[int]
    owner: Mapped[str]
    started_at: Mapped[datetime]
    finished_at: Mapped[datetime]
    outcome: Mapped[str] = mapped_column(String(16))
    cause: Mapped[str | None] = mapped_column(String(32))
    seconds: Mapped[float]
    cpu_seconds: Mapped[float]
    peak_mb: Mapped[float]
    scans: Mapped[int]
    points: Mapped[int]
    bytes: Mapped[int]
    cached: Mapped[bool]


class ModelFiguresRow(Owned, Base):
    """The figures of the latest job of a model, by what they are: as many rows as models and protocols.

    ``kind`` is a protocol, and ``figures`` then ``{"primal": {…}, "refined": {…}}`` of ``Quality.as_dict()``; or
    ``estimates``, and ``figures`` then the means over the scans of what l3ps.evaluate.estimates tells without truth.
    """

    __tablename__ = "model_figures"
    noun: ClassVar[str] = "figures"

    model_id: Mapped[str] = mapped_column(ForeignKey("models.id", ondelete="CASCADE"), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    job_id: Mapped[str] = mapped_column(String(32))
    figures: Mapped[Json]
    finished_at: Mapped[datetime]


ESTIMATES = "estimates"
