"""Projects, which the operator makes, and the caller's own."""

from __future__ import annotations

from l3ps_api.keyring import Principal
from l3ps_api.pages import cut
from l3ps_api.projects.schemas import KeyRef, Me, Project, ProjectPage, ProjectRef
from l3ps_api.services import Services
from l3ps_platform.catalog import keys, projects
from l3ps_platform.catalog.requests import note_result


def me(services: Services, principal: Principal) -> Me:
    """The caller."""
    with services.catalog.reading() as session:
        project = projects.get(session, principal.project_id)
        key = keys.get(session, principal.key_id) if principal.key_id is not None else None
    return Me(
        project=ProjectRef(id=project.id, name=project.name),
        scope=principal.scope,
        key=KeyRef(id=key.id, name=key.name) if key is not None else None,
    )


def create(services: Services, name: str) -> Project:
    """A new project. Conflict when the name is taken."""
    with services.catalog.transaction() as tx:
        row = projects.add(tx, name)
        note_result(tx.session, "projects", row.id)
        return Project.of(row)


def page(services: Services, limit: int, cursor: str | None) -> ProjectPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = projects.page(session, limit=limit + 1, before=cursor)
    shown, following = cut(rows, limit)
    return ProjectPage(items=[Project.of(row) for row in shown], next=following)


def get(services: Services, project_id: str) -> Project:
    """One project. NotFound."""
    with services.catalog.reading() as session:
        return Project.of(projects.get(session, project_id))


def delete(services: Services, project_id: str) -> None:
    """Close an empty project; its keys end at once. NotFound, Conflict while it has contents."""
    with services.catalog.transaction() as tx:
        projects.delete(tx, project_id)
