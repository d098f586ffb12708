"""Tables of what lies in the object store for several jobs at once, and of how long it is kept."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from l3ps_platform.catalog.base import Base, Owned
from l3ps_platform.catalog.states import OutputState, StageName


class OutputRow(Owned, Base):
    """The objects below one content-addressed prefix: what a stage computed, or is about to.

    There is a row before there is an object, so that none is forgotten. A doomed one is being deleted: nobody may begin
    to use it. ``bytes`` is known once the stage is done.
    """

    __tablename__ = "outputs"
    noun = "output"
    __table_args__ = (Index(None, "project_id"), Index(None, "state"))

    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    stage: Mapped[StageName]
    bytes: Mapped[int] = mapped_column(default=0)
    state: Mapped[OutputState] = mapped_column(default=OutputState.LIVE)
    created_at: Mapped[datetime]
    last_used_at: Mapped[datetime]


class OutputUseRow(Base):
    """A stage's claim to an output; it counts while the stage's job is not deleted or its training not long over."""

    __tablename__ = "output_uses"
    __table_args__ = (Index(None, "output_key"),)

    stage_id: Mapped[str] = mapped_column(ForeignKey("stages.id", ondelete="CASCADE"), primary_key=True)
    output_key: Mapped[str] = mapped_column(ForeignKey("outputs.key", ondelete="CASCADE"), primary_key=True)


class RetentionRow(Owned, Base):
    """What a project keeps of finished jobs' labels and drive archives; None is no limit. ``id`` is the project's."""

    __tablename__ = "retention"
    noun = "retention"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    max_age_days: Mapped[int | None]
    max_bytes: Mapped[int | None]
