"""Server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from l3ps_api.auth import PrincipalDep
from l3ps_api.events import service
from l3ps_api.events.hub import EventHub
from l3ps_api.events.schemas import Event, JobProgress
from l3ps_api.events.stream import EventStream, told
from l3ps_api.jobs.schemas import Job
from l3ps_api.services import ServicesDep

router = APIRouter(prefix="/v1", tags=["events"])


def _hub(request: Request) -> EventHub:
    found: EventHub = request.app.state.events
    return found


HubDep = Annotated[EventHub, Depends(_hub)]


async def _place(hub: HubDep, principal: PrincipalDep) -> AsyncIterator[None]:
    with hub.places.hold(principal.project_id):
        yield  # until the answer has been sent


_PLACED = [Depends(_place)]
LastEventId = Annotated[
    int | None,
    Header(
        alias="Last-Event-ID",
        ge=0,
        lt=1 << 63,
        description="The `id` of the last message received: all that happened since is sent first. "
        "The log goes back 30 days unless the service is set otherwise.",
    ),
]


_DOCUMENTS = {EventStream.media_type: {"schema": {"type": "object"}}}
"""The schemas are those of the messages' data; of a stream as a whole there is nothing to say."""


@router.get(
    "/jobs/{job_id}/events",
    status_code=200,
    response_class=EventStream,
    dependencies=_PLACED,
    responses={
        200: {
            "model": Job | Event | JobProgress,
            "content": _DOCUMENTS,
            "description": "Server-sent events, the `data` of each a JSON document: `snapshot` (the job, where no "
            "Last-Event-ID was sent), then one message for each event, named after its type, and `progress` whenever "
            "the stages have moved. Ends with the job's last event.",
        },
        204: {"description": "The job is over and the client has been told: a browser asks no more."},
    },
)
async def follow_job(job_id: str, services: ServicesDep, hub: HubDep, last_event_id: LastEventId = None) -> Response:
    """Follow a job. A stream that breaks is resumed with the last message's id, and nothing is missed."""
    feed = await run_in_threadpool(service.of_job, services, job_id, last_event_id)
    return Response(status_code=204) if feed is None else EventStream(told(hub, feed))


@router.get(
    "/events",
    status_code=200,
    response_class=EventStream,
    dependencies=_PLACED,
    responses={
        200: {
            "model": Event,
            "content": _DOCUMENTS,
            "description": "Server-sent events, the `data` of each a JSON document: `open` (where no Last-Event-ID was "
            "sent), then one message for each event, named after its type.",
        }
    },
)
async def follow_project(
    services: ServicesDep,
    principal: PrincipalDep,
    hub: HubDep,
    kinds: Annotated[
        str | None,
        Query(max_length=500, description="Only these types, separated by commas; `job.*` takes a group."),
    ] = None,
    subject: Annotated[
        str | None,
        Query(max_length=40, pattern="^[a-z0-9_]*$", description="Only of this job, drive, model or training."),
    ] = None,
    last_event_id: LastEventId = None,
) -> Response:
    """Follow all that happens in the project. A stream that breaks is resumed with the last message's id."""
    feed = await run_in_threadpool(service.of_project, services, principal.project_id, kinds, subject, last_event_id)
    return EventStream(told(hub, feed))
