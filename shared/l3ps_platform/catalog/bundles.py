"""Queries for model bundles."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import func, or_, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog import queries
from l3ps_platform.catalog.models import JobRow, ModelRow, StageRow
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.catalog.states import ACTIVE, ModelState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id


def add(
    tx: Transaction,
    *,
    name: str,
    filename: str,
    size: int,
    object_key: str,
    sha256: str | None = None,
    project_id: str | None = None,
) -> ModelRow:
    """A new model in state ``uploaded``; Conflict when the name is taken by a model that was not rejected.

    It belongs to the given project, else to the transaction's.
    A rejected model that no job ever used gives up its name. :func:`l3ps_platform.workflow.accept_model` also has
    the new one checked.
    """
    project_id = project_of(tx.session, project_id)
    taken = named(tx.session, name, project_id)
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
        project_id=project_id,
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
    return queries.get(session, ModelRow, id)


def named(session: Session, name: str, project_id: str | None = None) -> ModelRow | None:
    """The model of this name in a project, held until the transaction ends; None where the name is free."""
    mine = ModelRow.project_id == project_of(session, project_id)
    return session.scalars(select(ModelRow).where(ModelRow.name == name, mine).with_for_update()).one_or_none()


def by_name(session: Session, name: str, project_id: str | None = None) -> ModelRow:
    """One model of a project by name, or by id; the project is the session's where none is given. NotFound.

    An id goes before a name: else whoever names a model like another's id would put it in that one's place.
    """
    mine = ModelRow.project_id == project_of(session, project_id)
    rows = session.scalars(select(ModelRow).where(or_(ModelRow.id == name, ModelRow.name == name), mine))
    found = sorted((row for row in rows if row.deleted_at is None), key=lambda row: row.id != name)
    if not found:
        raise NotFound(ModelRow.noun, name)
    return found[0]


def lock(session: Session, id: str) -> ModelRow:
    """One model, held against concurrent changes until the transaction ends. NotFound."""
    return queries.lock(session, ModelRow, id)


def page(session: Session, *, limit: int = 50, before: str | None = None) -> list[ModelRow]:
    """Models, newest first, after the cursor ``before`` (the last id of the page before)."""
    return queries.page(session, ModelRow, limit=limit, before=before)


def many(session: Session, ids: Iterable[str]) -> dict[str, ModelRow]:
    """Models by id; ids without a row are left out."""
    return queries.many(session, ModelRow, ids)


def delete(tx: Transaction, id: str) -> ModelRow:
    """Hide a model and free its name; labels made with it stay. NotFound, Conflict while a job uses it.

    The reconciler deletes the archive: :func:`leftover_archives`.
    """
    row = lock(tx.session, id)
    if row.deleted_at is not None:
        raise NotFound("model", id)
    using = select(JobRow.id).where(JobRow.model_id == id, JobRow.state.in_(ACTIVE)).limit(1)
    job = tx.session.scalar(using)
    if job is not None:
        raise Conflict(f"model {row.name!r} is used by job {job}: cancel it or wait for its end")
    if row.state not in (ModelState.READY, ModelState.REJECTED):
        raise Conflict(f"model {row.name!r} is being checked: try again when it is ready")
    row.deleted_at = tx.now
    row.name = f"{row.name} (deleted {row.id})"
    tx.session.flush()
    return row


def leftover_archives(session: Session, limit: int = 100, after: str = "") -> list[ModelRow]:
    """Rejected and deleted models whose archive is still in the store, after the id ``after``."""
    gone = or_(ModelRow.state == ModelState.REJECTED, ModelRow.deleted_at.is_not(None))
    query = select(ModelRow).where(gone, ModelRow.object_key.is_not(None), ModelRow.id > after)
    return list(session.scalars(query.order_by(ModelRow.id).limit(limit)))
