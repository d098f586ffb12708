"""Queries for drives."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import DriveRow, JobRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import ACTIVE, DriveState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id


def add(
    tx: Transaction,
    *,
    name: str,
    filename: str,
    size: int,
    object_key: str | None = None,
    source: str | None = None,
    sha256: str | None = None,
) -> DriveRow:
    """A new drive in state ``uploaded``; :func:`l3ps_platform.workflow.accept_drive` also has it checked."""
    row = DriveRow(
        id=new_id("drv"),
        name=name,
        filename=filename,
        sha256=sha256,
        size=size,
        state=DriveState.UPLOADED,
        object_key=object_key,
        source=source,
        created_at=tx.now,
    )
    tx.session.add(row)
    tx.session.flush()
    return row


def get(session: Session, id: str) -> DriveRow:
    """One drive that is not deleted. NotFound."""
    return queries.get(session, DriveRow, id)


def lock(session: Session, id: str) -> DriveRow:
    """One drive, deleted or not, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, DriveRow, id)


def page(session: Session, *, limit: int = 50, before: str | None = None, sha256: str | None = None) -> list[DriveRow]:
    """Drives that are not deleted, newest first, after the cursor ``before`` (the last id of the page before)."""
    wanted = [DriveRow.sha256 == sha256] if sha256 is not None else []
    return queries.page(session, DriveRow, *wanted, limit=limit, before=before)


def many(session: Session, ids: Iterable[str]) -> dict[str, DriveRow]:
    """Drives by id, deleted ones too; ids without a row are left out."""
    return queries.many(session, DriveRow, ids)


def in_use(session: Session, id: str) -> list[str]:
    """Ids of the drive's jobs that are not finished."""
    return list(session.scalars(select(JobRow.id).where(JobRow.drive_id == id, JobRow.state.in_(ACTIVE))))


def delete(tx: Transaction, id: str) -> DriveRow:
    """Hide a drive; its finished jobs and their labels stay. NotFound, Conflict while a job uses it.

    The reconciler deletes the archive: :func:`leftover_archives`.
    """
    row = lock(tx.session, id)
    if row.deleted_at is not None:
        raise NotFound("drive", id)
    jobs = in_use(tx.session, id)
    if jobs:
        raise Conflict(f"drive {id} is used by job {jobs[0]}: cancel it or wait for its end")
    if row.state not in (DriveState.READY, DriveState.REJECTED):
        raise Conflict(f"drive {id} is being checked: try again when it is ready")
    row.deleted_at = tx.now
    tx.session.flush()
    return row


def leftover_archives(session: Session, limit: int = 100, after: str = "") -> list[DriveRow]:
    """Rejected and deleted drives whose archive is still in the store, after the id ``after``."""
    gone = or_(DriveRow.state == DriveState.REJECTED, DriveRow.deleted_at.is_not(None))
    query = select(DriveRow).where(gone, DriveRow.object_key.is_not(None), DriveRow.id > after)
    return list(session.scalars(query.order_by(DriveRow.id).limit(limit)))
