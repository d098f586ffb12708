"""Queries for projects; to be asked of an unscoped catalog."""

from __future__ import annotations

from sqlalchemy import ColumnElement, func, select
from sqlalchemy import delete as remove
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog import keys
from l3ps_platform.catalog.base import Owned
from l3ps_platform.catalog.event_rows import WebhookRow
from l3ps_platform.catalog.models import (
    DEFAULT_PROJECT,
    AnnotationsRow,
    DriveRow,
    JobRow,
    ModelRow,
    ProjectRow,
    TrainingRow,
    UploadRow,
)
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.source_rows import RuleRow
from l3ps_platform.catalog.states import ACTIVE, UploadState
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id

_CONTENTS: tuple[tuple[str, type[Owned], ColumnElement[bool]], ...] = (
    ("drives", DriveRow, DriveRow.deleted_at.is_(None)),
    ("models", ModelRow, ModelRow.deleted_at.is_(None)),
    ("annotations", AnnotationsRow, AnnotationsRow.deleted_at.is_(None)),
    ("jobs", JobRow, JobRow.deleted_at.is_(None)),
    ("open uploads", UploadRow, UploadRow.state == UploadState.OPEN),
    ("unfinished trainings", TrainingRow, TrainingRow.state.in_(ACTIVE)),
)
"""What keeps a project from being deleted."""


def add(tx: Transaction, name: str) -> ProjectRow:
    """A new project. Conflict when the name is taken."""
    row = ProjectRow(id=new_id("prj"), name=name, created_at=tx.now)
    try:
        with tx.session.begin_nested():
            tx.session.add(row)
    except IntegrityError:
        raise Conflict(f"there is a project named {name!r} already: choose another name") from None
    return row


def get(session: Session, id: str) -> ProjectRow:
    """One project. NotFound."""
    row = session.get(ProjectRow, id)
    if row is None or row.deleted_at is not None:
        raise NotFound("project", id)
    return row


def page(session: Session, *, limit: int, before: str | None = None) -> list[ProjectRow]:
    """Projects, newest first; the default one, whose id holds no time, comes first."""
    query = select(ProjectRow).where(ProjectRow.deleted_at.is_(None))
    if before is not None:
        query = query.where(ProjectRow.id < before)
    return list(session.scalars(query.order_by(ProjectRow.id.desc()).limit(limit)))


def delete(tx: Transaction, id: str) -> None:
    """Close an empty project: its keys, rules and webhooks end and its name becomes free.

    NotFound; Conflict while it has contents.
    """
    query = select(ProjectRow).where(ProjectRow.id == id, ProjectRow.deleted_at.is_(None)).with_for_update()
    row = tx.session.scalars(query).one_or_none()
    if row is None:
        raise NotFound("project", id)
    if id == DEFAULT_PROJECT:
        raise Conflict("the default project cannot be deleted: it is where the operator acts")
    counts = {
        noun: tx.session.scalar(select(func.count()).select_from(kind).where(kind.project_id == id, there))
        for noun, kind, there in _CONTENTS
    }
    left = [f"{count} {noun}" for noun, count in counts.items() if count]
    if left:
        raise Conflict(f"project {id} still has {', '.join(left)}: delete or cancel them first")
    keys.revoke_all(tx, id)
    for kind in (RuleRow, WebhookRow):
        tx.session.execute(remove(kind).where(kind.project_id == id))
    row.name, row.deleted_at = f"{row.name[:150]} (deleted {id})", tx.now
    tx.session.flush()
