"""Queries for POSTs that carry an Idempotency-Key: who does the work, what it made, what was answered.

A request holds its key by a lease. While it is bound (:func:`bound`), every transaction it commits also writes down on
its row which resource it made, and fails if the lease has passed to another request in the meantime. So an effect and
its note are one commit, and a repetition after a crash finds either both or neither.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import delete, event, func, select, tuple_, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog.access_rows import RequestRow
from l3ps_platform.catalog.base import Owned
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.errors import Conflict

Made = tuple[str, str]
"""A resource: its table, which is also its collection under /v1, and its id."""


@dataclass(frozen=True, slots=True)
class Held:
    """A key that a request holds: the work is its own to do.

    Attributes:
        project_id, key, owner: of the row.
        made: what an earlier try had made when it was cut off.
        kinds: tables whose new rows count as what was made.
        only: the one of them that counts, where the request asks for a resource of that kind.
    """

    project_id: str
    key: str
    owner: str
    made: Made | None = None
    kinds: frozenset[str] = field(default=frozenset())
    only: str | None = None


@dataclass(frozen=True, slots=True)
class Kept:
    """The answer to an earlier request with this key; ``body`` is None where it was too large to keep."""

    status: int
    headers: dict[str, str]
    body: bytes | None
    made: Made | None


@dataclass(frozen=True, slots=True)
class Busy:
    """Another request with this key is in progress; its lease has ``seconds`` to go."""

    seconds: float


class TooMany(Exception):  # noqa: N818
    """The project has as many keys as it may."""


class OtherRequest(Exception):  # noqa: N818
    """The key was used for a different request."""


def begin(
    tx: Transaction, key: str, fingerprint: str, *, lease_seconds: float, keep_seconds: float, most: int
) -> Held | Kept | Busy:
    """Take a key of the transaction's project, or learn what became of it.

    Args:
        tx: a transaction of a scoped catalog.
        key: as the client sent it.
        fingerprint: SHA-256 of what the client asked for.
        lease_seconds: how long others wait for this request before they take it for dead.
        keep_seconds: life of the key.
        most: keys that a project may have at a time.

    Raises:
        OtherRequest: the key belongs to a different request.
        TooMany: the key is new, and the project has ``most`` already.
    """
    owner, project = secrets.token_hex(16), project_of(tx.session)
    lease_until = tx.now + timedelta(seconds=lease_seconds)
    row = _lock(tx.session, key)
    if row is None:
        if _alive(tx.session, project, most) >= most:
            raise TooMany(project)
        fresh = RequestRow(key=key, **_blank(fingerprint, owner, lease_until, tx.now, keep_seconds))
        try:
            with tx.session.begin_nested():
                tx.session.add(fresh)
            return Held(project, key, owner)
        except IntegrityError:  # the same request, in parallel: the database says who was first
            row = _lock(tx.session, key)
            if row is None:
                return Busy(lease_seconds)
    if row.expires_at <= tx.now:
        for name, value in _blank(fingerprint, owner, lease_until, tx.now, keep_seconds).items():
            setattr(row, name, value)
        tx.session.flush()
        return Held(project, key, owner)
    if row.fingerprint != fingerprint:
        raise OtherRequest(key)
    made = (row.result_kind, row.result_id) if row.result_kind and row.result_id else None
    if row.status is not None:
        return Kept(row.status, row.headers or {}, row.body, made)
    if row.lease_until > tx.now:
        return Busy((row.lease_until - tx.now).total_seconds())
    row.owner, row.lease_until = owner, lease_until
    tx.session.flush()
    return Held(project, key, owner, made)


def finish(
    tx: Transaction, held: Held, status: int, headers: dict[str, str], body: bytes, *,
    limit: int, private: bool = False, again: frozenset[str] = frozenset(),
) -> None:  # fmt: skip
    """Keep the answer. Does nothing where the key has passed to another request.

    Args:
        tx: a transaction of a scoped catalog.
        held: the key.
        status, headers, body: of the answer.
        limit: bytes of the largest body that is kept. A larger one is made again from the resource that is noted; where
            none is, the request changed nothing, and the key is given back: a repetition does it again.
        private: the body holds what must lie nowhere, such as signed URLs: kept only where it is that of a resource.
        again: tables whose resources answer a repetition, so that no body is kept.
    """
    row = _lock(tx.session, held.key)
    if row is None or row.owner != held.owner or row.status is not None:
        return
    if row.result_id is None and (private or len(body) > limit):
        tx.session.delete(row)
    else:
        remade = row.result_id is not None and (row.result_kind in again or len(body) > limit)
        row.status, row.headers, row.body = status, headers, None if remade else body
    tx.session.flush()


def release(tx: Transaction, held: Held) -> None:
    """Give the key back: the request failed. What it made all the same stays noted, for the next to answer with."""
    mine = _mine(held)
    gone = delete(RequestRow).where(*mine, RequestRow.result_id.is_(None))
    tx.session.execute(gone, execution_options={"synchronize_session": False})
    _change(tx.session, held, lease_until=tx.now)


def purge(tx: Transaction, most: int = 5000) -> int:
    """Forget keys whose time is over, ``most`` at once: somebody's request waits for it. Returns how many."""
    row = RequestRow
    old = select(row.project_id, row.key).where(row.expires_at <= tx.now).limit(most)
    # Asked once more: a key may have been taken anew since it was found.
    gone = delete(row).where(tuple_(row.project_id, row.key).in_(old), row.expires_at <= tx.now)
    return _count(tx.session.execute(gone, execution_options={"synchronize_session": False}))


@contextmanager
def bound(held: Held) -> Iterator[None]:
    """What is committed inside, in this context and the threads that inherit it, is the effect of this request."""
    token = _current.set(held)
    try:
        yield
    finally:
        _current.reset(token)


def note_result(session: Session, kind: str, id: str) -> None:
    """Say which resource answers a repetition of this request, where the transaction makes no new one.

    For acts that must not happen twice, such as a retry. Does nothing for a request without a key.
    """
    session.info["result"] = (kind, id)


_current: ContextVar[Held | None] = ContextVar("l3ps_request", default=None)


@event.listens_for(Session, "after_flush")
def _see_new_rows(session: Session, _context: object) -> None:
    held = _current.get()
    if held is None:
        return
    for row in session.new:
        if isinstance(row, Owned) and row.__tablename__ in held.kinds:  # type: ignore[attr-defined]
            session.info.setdefault("made", []).append(row)


@event.listens_for(Session, "before_commit")
def _note_result(session: Session) -> None:
    held = _current.get()
    if held is None or session.in_nested_transaction():
        return
    session.flush()
    made = session.info.get("result")
    for row in session.info.pop("made", []):
        # A row of a savepoint that was rolled back has left the session.
        if made is None and row in session and held.only in (None, row.__tablename__):
            made = (row.__tablename__, row.id)
    values: dict[str, Any] = {"owner": held.owner}
    if made is not None:
        values = {
            "result_kind": func.coalesce(RequestRow.result_kind, made[0]),
            "result_id": func.coalesce(RequestRow.result_id, made[1]),
        }
    if not _change(session, held, **values):
        raise Conflict("this request took so long that another one with its Idempotency-Key took over: repeat it")


def _alive(session: Session, project: str, most: int) -> int:
    """How many keys a project has, counted to ``most``: 100,000 take SQLite 7 ms, what is usual much less."""
    found = select(RequestRow.key).where(RequestRow.project_id == project).limit(most).subquery()
    return session.scalars(select(func.count()).select_from(found)).one()


def _lock(session: Session, key: str) -> RequestRow | None:
    query = select(RequestRow).where(RequestRow.key == key).with_for_update()
    return session.scalars(query, execution_options={"populate_existing": True}).one_or_none()


def _blank(
    fingerprint: str, owner: str, lease_until: datetime, now: datetime, keep_seconds: float
) -> dict[str, Any]:  # fmt: skip
    nothing = dict.fromkeys(("status", "headers", "body", "result_kind", "result_id"))
    expires_at = now + timedelta(seconds=keep_seconds)
    return {
        **nothing, "fingerprint": fingerprint, "owner": owner, "lease_until": lease_until, "created_at": now,
        "expires_at": expires_at,
    }  # fmt: skip


def _mine(held: Held) -> tuple[Any, ...]:
    row = RequestRow
    return (
        row.project_id == held.project_id, row.key == held.key, row.owner == held.owner, row.status.is_(None)
    )  # fmt: skip


def _change(session: Session, held: Held, **values: Any) -> bool:
    query = update(RequestRow).where(*_mine(held)).values(**values)
    return _count(session.execute(query, execution_options={"synchronize_session": False})) > 0


def _count(result: Any) -> int:
    return int(result.rowcount)
