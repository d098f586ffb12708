"""Queries for rules and arrivals."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from sqlalchemy import delete as sql_delete
from sqlalchemy import func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.catalog.source_rows import ArrivalRow, RuleRow
from l3ps_platform.errors import Conflict
from l3ps_platform.ids import new_id


def add(tx: Transaction, *, name: str, bucket: str, prefix: str, suffix: str | None, settings: Json) -> RuleRow:
    """A new rule. Conflict when the name is taken."""
    row = RuleRow(
        id=new_id("rul"),
        name=name,
        bucket=bucket,
        prefix=prefix,
        suffix=suffix,
        settings=settings,
        created_at=tx.now,
    )
    try:
        with tx.session.begin_nested():
            tx.session.add(row)
    except IntegrityError:
        raise Conflict(f"there is a rule named {name!r} already: delete it, or choose another name") from None
    return row


def get(session: Session, id: str) -> RuleRow:
    """One rule. NotFound."""
    return queries.get(session, RuleRow, id)


def page(session: Session, *, limit: int = 50, before: str | None = None) -> list[RuleRow]:
    """Rules, newest first, after the cursor ``before`` (the last id of the page before)."""
    return queries.page(session, RuleRow, limit=limit, before=before)


def count(session: Session) -> int:
    """How many there are."""
    return session.scalar(select(func.count(RuleRow.id))) or 0


def of_buckets(session: Session, buckets: Iterable[str]) -> list[RuleRow]:
    """The rules for these buckets."""
    return list(session.scalars(select(RuleRow).where(RuleRow.bucket.in_(set(buckets))).order_by(RuleRow.id)))


def delete(tx: Transaction, id: str) -> None:
    """Delete a rule and what is known of its arrivals; jobs stay. NotFound."""
    row = queries.lock(tx.session, RuleRow, id)
    tx.session.execute(sql_delete(ArrivalRow).where(ArrivalRow.rule_id == row.id))
    tx.session.delete(row)
    tx.session.flush()


def note(tx: Transaction, found: Sequence[tuple[RuleRow, str, str, str]]) -> list[str]:
    """Record what met a rule: (rule, digest, key, source); what is recorded already stays as it is.

    Returns:
        Ids of the new arrivals.
    """
    if not found:
        return []
    values = [
        {
            "id": new_id("arr"),
            "project_id": project_of(tx.session, rule.project_id),
            "rule_id": rule.id,
            "digest": digest,
            "key": key,
            "source": source,
            "created_at": tx.now,
        }
        for rule, digest, key, source in found
    ]
    insert = postgresql.insert if tx.session.get_bind().dialect.name == "postgresql" else sqlite.insert
    for first in range(0, len(values), 500):  # SQLite takes some thousand values in a statement
        statement = insert(ArrivalRow).values(values[first : first + 500])
        tx.session.execute(statement.on_conflict_do_nothing(index_elements=["rule_id", "digest"]))
    ids = [str(value["id"]) for value in values]
    kept: set[str] = set()
    for first in range(0, len(ids), 500):
        some = select(ArrivalRow.id).where(ArrivalRow.id.in_(ids[first : first + 500]))
        kept.update(tx.session.scalars(some))
    return [id for id in ids if id in kept]


def waiting(session: Session, limit: int = 100, *, after: str = "", without: Collection[str] = ()) -> list[ArrivalRow]:
    """Arrivals that are no job yet, the oldest first, after the id ``after``; none of the projects ``without``."""
    query = select(ArrivalRow).where(ArrivalRow.settled_at.is_(None), ArrivalRow.project_id.not_in(without))
    return list(session.scalars(query.where(ArrivalRow.id > after).order_by(ArrivalRow.id).limit(limit)))


def lock_waiting(session: Session, id: str) -> ArrivalRow | None:
    """One arrival, held, if it is still waiting and nobody else holds it."""
    query = select(ArrivalRow).where(ArrivalRow.id == id, ArrivalRow.settled_at.is_(None))
    query = query.with_for_update(skip_locked=True)
    return session.scalars(query, execution_options={"populate_existing": True}).one_or_none()


def arrived(session: Session, rule_ids: Sequence[str]) -> dict[str, tuple[int, ArrivalRow]]:
    """How many arrivals each rule has had, and the latest; rules without any are left out."""
    of_rules = ArrivalRow.rule_id.in_(rule_ids)
    counted = select(ArrivalRow.rule_id, func.count(), func.max(ArrivalRow.id)).where(of_rules)
    counts = {rule: (count, last) for rule, count, last in session.execute(counted.group_by(ArrivalRow.rule_id))}
    rows = queries.many(session, ArrivalRow, [last for _, last in counts.values()])
    return {rule: (count, rows[last]) for rule, (count, last) in counts.items()}
