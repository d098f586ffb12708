"""What routes need of the platform, made once by the app factory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from fastapi import Depends, Query, Request
from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from l3ps_api.auth import PrincipalDep
from l3ps_api.jobs.documents import Documents
from l3ps_api.labels.manifests import Manifests
from l3ps_api.replies import asked_within
from l3ps_platform.catalog import DEFAULT_PROJECT
from l3ps_platform.catalog.session import Catalog
from l3ps_platform.ids import Prefix, is_id
from l3ps_platform.objects import ObjectStore
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings


@dataclass(frozen=True)
class Services:
    """The process' connections; each connects on first use."""

    settings: Settings
    catalog: Catalog
    store: ObjectStore
    queue: Queue
    documents: Documents = field(default_factory=Documents)
    manifests: Manifests = field(default_factory=Manifests)


async def _system(request: Request) -> Services:
    found: Services = request.app.state.services
    return found


# Async though they wait for nothing: of others FastAPI makes a visit to the thread pool each.
SystemDep = Annotated[Services, Depends(_system)]
"""For what belongs to no project: health, metrics, presigned objects."""


async def _own(request: Request, system: SystemDep, principal: PrincipalDep) -> Services:
    # Those who wait for the transaction that asks may have all connections of the other.
    catalog: Catalog = request.app.state.beside if asked_within(request.scope) else system.catalog
    return replace(system, catalog=catalog.scoped(principal.project_id))


ServicesDep = Annotated[Services, Depends(_own)]
"""For what acts for a client: its catalog shows the rows of the caller's project alone."""
Limit = Annotated[int, Query(ge=1, le=200, description="How many items at most.")]
Cursor = Annotated[str | None, Query(description="`next` of the page before.", max_length=40)]
"""Each list takes its own alone: ``Annotated[Cursor, id_of("job")]``."""


def id_of(prefix: Prefix) -> AfterValidator:
    """Has a cursor be an id of one kind."""

    def check(given: str | None) -> str | None:
        if given is None or is_id(given, prefix) or (prefix, given) == ("prj", DEFAULT_PROJECT):
            return given
        raise PydanticCustomError("malformed_cursor", "it is no cursor of this list")

    return AfterValidator(check)
