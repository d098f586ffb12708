"""Queries for uploads."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import UploadRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import UploadState
from l3ps_platform.errors import Conflict
from l3ps_platform.ids import new_id


def add(
    tx: Transaction,
    *,
    kind: Literal["drive", "model", "annotations"],
    filename: str,
    size: int,
    parts: int,
    part_size: int = 0,
    object_key: str,
    s3_upload_id: str,
    seconds: int,
    id: str | None = None,
    sha256: str | None = None,
) -> UploadRow:
    """A new open upload that expires after ``seconds``; ``id`` where the key was made from it beforehand,
    ``sha256`` as the client claims it."""
    row = UploadRow(
        id=id or new_id("upl"),
        kind=kind,
        filename=filename,
        size=size,
        sha256=sha256,
        parts=parts,
        part_size=part_size,
        state=UploadState.OPEN,
        object_key=object_key,
        s3_upload_id=s3_upload_id,
        created_at=tx.now,
        expires_at=tx.now + timedelta(seconds=seconds),
    )
    tx.session.add(row)
    tx.session.flush()
    return row


def get(session: Session, id: str) -> UploadRow:
    """One upload. NotFound."""
    return queries.get(session, UploadRow, id)


def page(
    session: Session, *, limit: int = 50, before: str | None = None, state: UploadState | None = None
) -> list[UploadRow]:
    """Uploads, newest first, after the cursor ``before`` (the last id of the page before)."""
    chosen = [UploadRow.state == state] if state is not None else []
    return queries.page(session, UploadRow, *chosen, limit=limit, before=before)


def lock(session: Session, id: str) -> UploadRow:
    """One upload, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, UploadRow, id)


def close(tx: Transaction, id: str, state: UploadState, result_id: str | None = None) -> UploadRow:
    """Complete or abort an open upload. NotFound, Conflict when it is not open."""
    row = lock(tx.session, id)
    if row.state is not UploadState.OPEN:
        raise Conflict(f"upload {id} is {row.state}: begin a new one")
    row.state = state
    row.result_id = result_id
    tx.session.flush()
    return row


def leftover(session: Session, limit: int = 100, after: str = "") -> list[UploadRow]:
    """Aborted uploads, after the id ``after``, whose parts may still be in the store.

    A clean one has an empty ``s3_upload_id``.
    """
    query = select(UploadRow).where(UploadRow.state == UploadState.ABORTED, UploadRow.s3_upload_id != "")
    return list(session.scalars(query.where(UploadRow.id > after).order_by(UploadRow.id).limit(limit)))


def expired(session: Session, now: datetime, limit: int = 100) -> list[UploadRow]:
    """Open uploads whose time is over."""
    query = select(UploadRow).where(UploadRow.state == UploadState.OPEN, UploadRow.expires_at < now)
    return list(session.scalars(query.order_by(UploadRow.expires_at).limit(limit)))
