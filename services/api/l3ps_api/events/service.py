"""What a client that opens a stream knows already, and what it is to be told."""

from __future__ import annotations

from fastapi.sse import format_sse_event

from l3ps_api.events.hub import PAGE, Entry
from l3ps_api.events.stream import Feed
from l3ps_api.jobs import service as job_service
from l3ps_api.problems import invalid
from l3ps_api.services import Services
from l3ps_platform.catalog import Catalog, EventKind, events, jobs
from l3ps_platform.catalog.kinds import select_kinds


def of_job(services: Services, job_id: str, last: int | None) -> Feed | None:
    """The stream of one job, from where the client left off or from a snapshot. NotFound.

    None when the job is over and the client has been told.
    """

    def read(seq: int) -> list[Entry]:
        return _read(services.catalog, seq, subject=job_id)

    def wants(entry: Entry) -> bool:
        return entry.subject_id == job_id

    with services.catalog.reading() as session:
        over = jobs.get(session, job_id).state.final
        known = events.last_seq(session)  # after the state: its event is among these
    if last is not None and last <= known:
        return None if over and not read(last) else Feed(last, read, wants, job_id)
    # The document itself is the one that is kept for all who ask: a stream holds no copy of its 2 MB.
    snapshot = job_service.encoded(services, job_id)
    opening = (f"event: snapshot\nid: {known}\ndata: ".encode(), snapshot, b"\n\n")
    return Feed(known, read, wants, job_id, opening, over)


def of_project(services: Services, project_id: str, kinds: str | None, subject: str | None, last: int | None) -> Feed:
    """The stream of all that happens in a project, from where the client left off or from now."""
    try:
        chosen = select_kinds(part.strip() for part in kinds.split(",")) if kinds is not None else frozenset(EventKind)
    except ValueError as error:
        remedy = f"Separate them by commas: {', '.join(EventKind)}, or groups such as job.*."
        raise invalid("query kinds", str(error), remedy) from None

    def read(seq: int) -> list[Entry]:
        return _read(services.catalog, seq, subject=subject, kinds=chosen)

    def wants(entry: Entry) -> bool:
        return entry.project_id == project_id and entry.kind in chosen and subject in (None, entry.subject_id)

    with services.catalog.reading() as session:
        known = events.last_seq(session)
    if last is not None and last <= known:
        return Feed(last, read, wants)
    # So that a client that is cut off before the first event knows where to go on.
    opening = format_sse_event(event="open", data_str=f'{{"seq": {known}}}', id=str(known))
    return Feed(known, read, wants, opening=(opening,))


def _read(
    catalog: Catalog, seq: int, *, subject: str | None = None, kinds: frozenset[EventKind] | None = None
) -> list[Entry]:
    with catalog.reading() as session:
        return [Entry.of(row) for row in events.after(session, seq, limit=PAGE, subject=subject, kinds=kinds)]
