"""A job's document is kept between two requests, and yet never older than the catalog."""

import json
from collections.abc import Callable
from datetime import timedelta

import pytest

from l3ps_api.jobs import service
from l3ps_api.jobs.documents import Documents
from l3ps_api.services import Services
from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, JobState, jobs
from l3ps_platform.errors import NotFound
from l3ps_platform.settings import Settings

RETRY = workflow.Retry(3, 0.0)
FAULT = {"message": "it broke", "problems": []}


@pytest.fixture
def services(catalog: Catalog) -> Services:
    return Services(Settings(), catalog, None, None)


def test_every_change_of_a_job_shows_at_once(catalog: Catalog, services: Services, play, sent, tidy, cost) -> None:
    """A job is led through its life; after each step the kept document is the one that would be made anew."""
    job = ""
    seen: list[bytes] = []

    def look() -> None:
        kept = service.encoded(services, job)
        assert json.loads(kept) == json.loads(service.get(services, job).model_dump_json())
        assert service.encoded(services, job) is kept, "what has not changed is not made again"
        if not seen or kept != seen[-1]:
            seen.append(kept)

    def write(change: Callable) -> None:
        with catalog.transaction() as tx:
            change(tx)
        look()

    with catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="drive", filename="d.zip", size=9, object_key="uploads/u/d.zip").id
    model = play.model()
    with catalog.transaction() as tx:
        job = workflow.submit_job(tx, drive_id=drive, model=model).id
    look()
    check = play.take()
    look()
    write(lambda tx: workflow.report(tx, check, "unpack", 1, 2, fraction=0.5))
    info = {"scenes": [{"name": f"scene-{n}", "scans": 2, "points": 10} for n in range(2)]}
    verdict = {"usable": True, "problems": [], "sha256": "d" * 64, "format": "nuscenes", "info": info}
    write(lambda tx: workflow.drive_checked(tx, check, cost, **verdict))
    first, second = play.take(), play.take(owner="worker-2")
    look()
    for done in (1, 2):
        write(lambda tx, done=done: workflow.report(tx, first, "segment", done, 9, fraction=done / 9))
        write(lambda tx, done=done: workflow.report(tx, second, "segment", done, 9, fraction=done / 9))
    write(lambda tx: workflow.release(tx, second))
    write(lambda tx: workflow.fail(tx, first, FAULT, retry=RETRY, cost=cost))
    tidy()
    look()
    while sent:
        claim = play.take()
        look()
        write(lambda tx, claim=claim: workflow.complete(tx, claim, cost, quality={"of": "it"}))
    last = json.loads(seen[-1])
    assert (last["state"], last["progress"], last["quality"]) == ("succeeded", 1.0, {"of": "it"})
    assert len(seen) > 15


def test_a_cancelled_job_shows_at_once(catalog: Catalog, services: Services, play) -> None:
    job = play.submit(scenes=2)
    play.take()
    service.encoded(services, job)
    service.cancel(services, job)
    assert json.loads(service.encoded(services, job))["cancel_requested"]


def test_a_deleted_job_is_gone_though_its_document_was_kept(catalog: Catalog, services: Services, play) -> None:
    job = play.submit(scenes=1)
    service.cancel(services, job)
    service.encoded(services, job)
    service.delete(services, job)
    for read in (service.encoded, service.get):
        with pytest.raises(NotFound):
            read(services, job)


def test_a_kept_document_is_its_project_s_alone(catalog: Catalog, services: Services, play) -> None:
    job = play.submit(scenes=1)
    service.encoded(services, job)
    foreign = Services(services.settings, catalog.scoped("prj_other"), None, None, services.documents)
    with pytest.raises(NotFound):
        service.encoded(foreign, job)


def test_the_least_recently_asked_documents_make_room() -> None:
    documents, made = Documents(kept_bytes=20), []

    def make(name: str) -> bytes:
        made.append(name)
        return b"x" * 8

    for name in ("a", "b", "a", "c", "a", "b"):
        documents.get(name, (1,), lambda name=name: make(name))
    assert made == ["a", "b", "c", "b"]


def test_jobs_are_found_by_state_drive_model_and_time(catalog: Catalog, play, sent, cost) -> None:
    drive, model = play.drive(scenes=1), play.model()
    with catalog.transaction() as tx:
        ids = [workflow.submit_job(tx, drive_id=drive, model=model).id for _ in range(3)]
    ids.append(play.submit(scenes=1))
    with catalog.transaction() as tx:
        workflow.cancel_job(tx, ids[0])
        made = jobs.get(tx.session, ids[1]).created_at

    def found(**wanted: object) -> list[str]:
        with catalog.reading() as session:
            return [row.id for row in jobs.page(session, jobs.Wanted(**wanted))]

    assert found() == ids[::-1]
    assert found(states=[JobState.CANCELLED]) == ids[:1]
    assert found(states=[JobState.CANCELLED, JobState.QUEUED]) == ids[::-1]
    assert found(drive_id=drive) == found(model_id=model) == ids[2::-1]
    assert found(drive_id=drive, states=[JobState.QUEUED]) == ids[2:0:-1]
    assert found(created_after=made) == ids[::-1]
    assert found(created_before=made) == []
    assert found(created_before=made + timedelta(days=400)) == ids[::-1]
    assert found(created_after=made + timedelta(microseconds=1)) == ids[3:]
