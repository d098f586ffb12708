"""Queries for API keys. Secrets are compared in :mod:`l3ps_api`; here they are digests."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import or_, select, update
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.access_rows import ApiKeyRow
from l3ps_platform.catalog.models import ProjectRow
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.errors import Conflict


def add(
    tx: Transaction, *, id: str, name: str, scope: str, secret_sha256: str, expires_at: datetime | None
) -> ApiKeyRow:
    """A new key of the transaction's project."""
    row = ApiKeyRow(
        id=id, name=name, scope=scope, secret_sha256=secret_sha256, created_at=tx.now, expires_at=expires_at
    )
    tx.session.add(row)
    tx.session.flush()
    return row


def find(session: Session, id: str) -> ApiKeyRow | None:
    """One key of a project that is there, or None."""
    there = select(ProjectRow.id).where(ProjectRow.id == ApiKeyRow.project_id, ProjectRow.deleted_at.is_(None)).exists()
    return session.scalars(select(ApiKeyRow).where(ApiKeyRow.id == id, there)).one_or_none()


def hold_maker(tx: Transaction, maker: str | None, changed: str | None = None) -> None:
    """See that the project and the key that makes a secret have not ended, and do not before the commit.

    Args:
        tx: a transaction of a scoped catalog.
        maker: id of the key that asks; None for the operator.
        changed: id of the key that is changed, to be locked with it: two that change each other wait in one order.

    Raises:
        Conflict: one of them has ended.
    """
    mine = project_of(tx.session)
    there = select(ProjectRow).where(ProjectRow.id == mine, ProjectRow.deleted_at.is_(None))
    project = tx.session.scalars(there.with_for_update(read=True)).one_or_none()
    wanted = [id for id in (maker, changed) if id is not None]
    query = select(ApiKeyRow).where(ApiKeyRow.id.in_(wanted)).order_by(ApiKeyRow.id).with_for_update()
    rows = {row.id: row for row in tx.session.scalars(query, execution_options={"populate_existing": True})}
    ended = maker is not None and (maker not in rows or _ended(rows[maker], tx.now))
    if project is None or ended:
        raise Conflict("the project, or the key that asks, has ended meanwhile: ask with credentials that are good")


def get(session: Session, id: str) -> ApiKeyRow:
    """One key, revoked or not. NotFound."""
    return queries.get(session, ApiKeyRow, id)


def page(session: Session, *, limit: int, before: str | None = None) -> list[ApiKeyRow]:
    """Keys, newest first, revoked ones too."""
    return queries.page(session, ApiKeyRow, limit=limit, before=before)


def revoke(tx: Transaction, id: str) -> ApiKeyRow:
    """End a key; one that has ended stays as it is. NotFound."""
    row = queries.lock(tx.session, ApiKeyRow, id)
    row.revoked_at = row.revoked_at or tx.now
    tx.session.flush()
    return row


def rotate(tx: Transaction, id: str, secret_sha256: str, overlap_seconds: float) -> ApiKeyRow:
    """Give a key a new secret; the one before stays good for ``overlap_seconds``. NotFound, Conflict when revoked."""
    row = queries.lock(tx.session, ApiKeyRow, id)
    if _ended(row, tx.now):
        raise Conflict(f"key {id} has ended: make a new one with POST /v1/keys")
    row.previous_sha256 = row.secret_sha256 if overlap_seconds > 0 else None
    row.previous_until = tx.now + timedelta(seconds=overlap_seconds) if overlap_seconds > 0 else None
    row.secret_sha256 = secret_sha256
    tx.session.flush()
    return row


def renew(tx: Transaction, id: str, secret_sha256: str) -> ApiKeyRow:
    """Put another secret in the place of one that nobody has seen. NotFound."""
    row = queries.lock(tx.session, ApiKeyRow, id)
    row.secret_sha256 = secret_sha256
    tx.session.flush()
    return row


def revoke_all(tx: Transaction, project_id: str) -> None:
    """End every key of a project."""
    of_it = (ApiKeyRow.project_id == project_id, ApiKeyRow.revoked_at.is_(None))
    tx.session.execute(update(ApiKeyRow).where(*of_it).values(revoked_at=tx.now))


def note_use(tx: Transaction, id: str, seconds: float = 60.0) -> None:
    """Write down that a key is in use, if that was last done more than ``seconds`` ago."""
    long_ago = tx.now - timedelta(seconds=seconds)
    stale = or_(ApiKeyRow.last_used_at.is_(None), ApiKeyRow.last_used_at < long_ago)
    tx.session.execute(update(ApiKeyRow).where(ApiKeyRow.id == id, stale).values(last_used_at=tx.now))


def _ended(row: ApiKeyRow, now: datetime) -> bool:
    return row.revoked_at is not None or (row.expires_at is not None and row.expires_at <= now)
