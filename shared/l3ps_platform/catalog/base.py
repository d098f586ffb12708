"""What every table stands on: types that read the same on both databases, and the project that owns a row."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, ClassVar

from sqlalchemy import JSON, BigInteger, DateTime, Dialect, Enum, ForeignKey, MetaData, String, TypeDecorator
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import DeclarativeBase, Mapped, declared_attr, mapped_column

from l3ps_platform.catalog.states import (
    DeliveryState,
    DriveState,
    JobState,
    ModelState,
    OutputState,
    QueueName,
    StageName,
    StageState,
    UploadState,
)

Json = dict[str, Any]


class UtcDateTime(TypeDecorator[datetime]):
    """An aware UTC date on both databases (SQLite drops the zone)."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Store in UTC."""
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return with its zone."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def _states(kind: type[StrEnum]) -> Enum:
    # Plain text with a CHECK: a native PostgreSQL enum cannot lose a value and SQLite has none.
    return Enum(
        kind,
        native_enum=False,
        length=16,
        create_constraint=True,
        name=kind.__name__.lower(),
        values_callable=lambda members: [member.value for member in members],
    )


class Base(DeclarativeBase):
    """Base of every table."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {  # noqa: RUF012
        Json: JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql"),
        datetime: UtcDateTime(),
        int: BigInteger(),
        UploadState: _states(UploadState),
        DriveState: _states(DriveState),
        ModelState: _states(ModelState),
        JobState: _states(JobState),
        StageState: _states(StageState),
        StageName: _states(StageName),
        OutputState: _states(OutputState),
        QueueName: _states(QueueName),
        DeliveryState: _states(DeliveryState),
    }


class Owned:
    """Mixin of rows that belong to a project.

    A scoped catalog (:meth:`~l3ps_platform.catalog.session.Catalog.scoped`) shows its sessions no others, and gives its
    project to new ones. ``noun`` is what errors call such a row.
    """

    noun: ClassVar[str]

    @declared_attr
    def project_id(cls) -> Mapped[str]:  # noqa: N805
        """The project."""
        return mapped_column(String(32), ForeignKey("projects.id"))
