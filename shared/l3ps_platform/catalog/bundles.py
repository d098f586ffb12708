"""Queries for model bundles."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import JobRow, ModelRow, StageRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import ModelState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id


def add(
    tx: Transaction, *, name: str, filename: str, size: int, object_key: str, sha256: str | None = None
) -> ModelRow:
    """A new model in state ``uploaded``; Conflict when the name is taken by a model that was not rejected.

    A rejected model that no job ever used gives up its name. :func:`l3ps_platform.workflow.accept_model` also has
    the new one checked.
    """
    taken = tx.session.scalars(select(ModelRow).where(ModelRow.name == name).with_for_update()).one_or_none()
    if taken is not None:
        if taken.state is not ModelState.REJECTED:
            raise Conflict(f"there is a model named {name!r} already: choose another name")
        used = tx.session.scalar(select(func.count()).select_from(JobRow).where(JobRow.model_id == taken.id))
        if used:
            taken.name = f"{name} (rejected {taken.id})"
        else:
            for stage in tx.session.scalars(select(StageRow).where(StageRow.model_id == taken.id)):
                tx.session.delete(stage)
            tx.session.flush()
            tx.session.delete(taken)
        tx.session.flush()
    row = ModelRow(
        id=new_id("mdl"),
        name=name,
        filename=filename,
        sha256=sha256,
        size=size,
        state=ModelState.UPLOADED,
        object_key=object_key,
        created_at=tx.now,
    )
    try:
        with tx.session.begin_nested():
            tx.session.add(row)
    except IntegrityError:  # another upload took the name in this moment
        raise Conflict(f"there is a model named {name!r} already: choose another name") from None
    return row


def get(session: Session, id: str) -> ModelRow:
    """One model by id. NotFound."""
    row = session.get(ModelRow, id)
    if row is None:
        raise NotFound("model", id)
    return row


def by_name(session: Session, name: str) -> ModelRow:
    """One model by name, or by id. NotFound."""
    row = session.scalars(select(ModelRow).where(ModelRow.name == name)).one_or_none()
    return row if row is not None else get(session, name)


def lock(session: Session, id: str) -> ModelRow:
    """One model, held against concurrent changes until the transaction ends. NotFound."""
    query = select(ModelRow).where(ModelRow.id == id).with_for_update()
    row = session.scalars(query, execution_options={"populate_existing": True}).one_or_none()
    if row is None:
        raise NotFound("model", id)
    return row


def page(session: Session, *, limit: int = 50, before: str | None = None) -> list[ModelRow]:
    """Models, newest first, after the cursor ``before`` (the last id of the page before)."""
    query = select(ModelRow)
    if before is not None:
        query = query.where(ModelRow.id < before)
    return list(session.scalars(query.order_by(ModelRow.id.desc()).limit(limit)))


def many(session: Session, ids: Iterable[str]) -> dict[str, ModelRow]:
    """Models by id; ids without a row are left out."""
    return {row.id: row for row in session.scalars(select(ModelRow).where(ModelRow.id.in_(set(ids))))}


def leftover_archives(session: Session, limit: int = 100) -> list[ModelRow]:
    """Rejected models whose archive is still in the store."""
    query = select(ModelRow).where(ModelRow.state == ModelState.REJECTED, ModelRow.object_key.is_not(None))
    return list(session.scalars(query.limit(limit)))
