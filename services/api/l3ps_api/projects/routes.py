"""Projects, where the gate lets the operator alone, and who the caller is."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Request, Response

from l3ps_api.auth import PrincipalDep
from l3ps_api.projects import service
from l3ps_api.projects.schemas import Me, Project, ProjectPage, ProjectRequest
from l3ps_api.services import Cursor, Limit, ServicesDep, SystemDep, id_of

router = APIRouter(prefix="/v1", tags=["access"])
ProjectCursor = Annotated[Cursor, id_of("prj")]


@router.get("/me")
def get_me(services: ServicesDep, principal: PrincipalDep) -> Me:
    """The caller: its project, its scope and its key."""
    return service.me(services, principal)


@router.post("/projects", status_code=201)
def create_project(request: ProjectRequest, response: Response, services: SystemDep) -> Project:
    """Make a project. To act in it, the operator names it in the header `L3PS-Project`, or makes a key in it."""
    project = service.create(services, request.name)
    response.headers["Location"] = f"/v1/projects/{project.id}"
    return project


@router.get("/projects")
def list_projects(services: SystemDep, limit: Limit = 50, cursor: ProjectCursor = None) -> ProjectPage:
    """Projects, newest first."""
    return service.page(services, limit, cursor)


@router.get("/projects/{project_id}")
def get_project(project_id: str, services: SystemDep) -> Project:
    """A project."""
    return service.get(services, project_id)


@router.delete("/projects/{project_id}", status_code=204)
def delete_project(project_id: str, services: SystemDep, http: Request) -> None:
    """Delete an empty project; its keys end at once. Refused while it has drives, models or unfinished work."""
    service.delete(services, project_id)
    http.app.state.keyring.forget()
