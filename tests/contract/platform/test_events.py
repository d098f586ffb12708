"""The event log: what happened is in it once, in the order of the commits, or not at all; on both databases."""

import threading

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, EventKind, JobState, ProjectRow, StageState, events, jobs
from l3ps_platform.workflow import Retry

pytestmark = pytest.mark.services
ERROR = {"message": "the store was away", "problems": []}


def kinds(catalog: Catalog, subject: str | None = None) -> list[str]:
    with catalog.reading() as session:
        return [event.kind for event in events.after(session, 0, subject=subject)]


def test_a_job_s_life_is_told_in_order_and_its_scenes_with_it(play, catalog) -> None:
    job = play.submit(scenes=2)
    play.finish_all()
    assert kinds(catalog) == [
        *("drive.ready", "model.ready"),
        *("job.queued", "job.running", "scene.done", "scene.done", "job.succeeded"),
    ]
    assert kinds(catalog, job) == ["job.queued", "job.running", "scene.done", "scene.done", "job.succeeded"]
    with catalog.reading() as session:
        *_, scene, over = events.after(session, 0, subject=job)
    assert (scene.data["name"], scene.data["state"], scene.data["job_id"]) == ("scene-1", "done", job)
    assert over.data["id"] == job and over.data["state"] == "succeeded" and "message" not in over.data


def test_failures_retries_and_their_reasons_are_told(play, catalog, tidy) -> None:
    job = play.submit(scenes=1)
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=Retry(2, 0)))
    tidy(retry_seconds=0)
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=Retry(2, 0)))
    with catalog.reading() as session:
        told = events.after(session, 0, subject=job)
    assert [e.kind for e in told] == ["job.queued", "job.running", "stage.retried", "scene.failed", "job.failed"]
    assert (told[2].data["stage"], told[2].data["attempt"]) == ("segment", 2)
    assert all("the store was away" in event.data["message"] for event in told[2:])


def test_a_job_that_waits_for_its_drive_fails_with_it(play, catalog, sent) -> None:
    model = play.model()
    with catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=9, object_key="uploads/u/d.zip")
        job = workflow.submit_job(tx, drive_id=drive.id, model=model)
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR))
    assert kinds(catalog, drive.id) == ["drive.rejected"]
    assert kinds(catalog, job.id) == ["job.queued", "job.failed"]


def test_cancelling_is_told_once(play, catalog) -> None:
    job = play.submit()
    for _ in range(2):
        with catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
    assert kinds(catalog, job) == ["job.queued", "job.cancelled"]


def test_a_scene_that_is_cancelled_between_its_stages_is_not_told_as_done(play, catalog, sent) -> None:
    """Its segment stage ends before it hears of the cancel: there are primal labels and no others."""
    job = play.submit(scenes=1)
    claim = play.take()
    with catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    with catalog.transaction() as tx:
        workflow.complete(tx, claim, workflow.Cost(1.0), output_key="o/primal")
    assert kinds(catalog, job) == ["job.queued", "job.running", "job.cancelled"]
    with catalog.reading() as session:
        assert [scene.state for scene in jobs.scenes(session, job)] == [StageState.CANCELLED]
    with catalog.transaction() as tx:
        workflow.retry_job(tx, job)
    assert play.finish_all() == ["refine", "publish"]
    assert kinds(catalog, job)[-2:] == ["scene.done", "job.succeeded"]


def test_what_was_rolled_back_did_not_happen(play, catalog) -> None:
    job = play.submit()
    with pytest.raises(ZeroDivisionError), catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
        raise ZeroDivisionError
    assert kinds(catalog, job) == ["job.queued"]
    assert play.job(job).state is JobState.QUEUED


def test_numbers_become_visible_in_their_order(play, catalog) -> None:
    """A transaction that takes its number first and commits last must not be passed by: a reader that has seen the
    second number would never look for the first one."""
    first, second = play.submit(1), play.submit(1)
    with catalog.reading() as session:
        before = events.last_seq(session)
    numbered, passed, seen = threading.Event(), threading.Event(), []

    def cancel_slowly() -> None:
        with catalog.transaction() as tx:
            workflow.cancel_job(tx, first)
            commit = tx.session.commit

            def wait_and_commit() -> None:
                numbered.set()
                passed.wait(0.3)  # the other overtakes in this time, if anything lets it
                commit()

            tx.session.commit = wait_and_commit

    def cancel_quickly() -> None:
        numbered.wait()
        with catalog.transaction() as tx:
            workflow.cancel_job(tx, second)
        with catalog.reading() as session:
            seen.extend(event.subject_id for event in events.after(session, before))
        passed.set()

    threads = [threading.Thread(target=work) for work in (cancel_slowly, cancel_quickly)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [first, second]


def test_a_pruned_number_is_not_given_again(play, catalog) -> None:
    play.submit(1)
    with catalog.transaction() as tx:
        last = events.last_seq(tx.session)
        events.prune(tx.session, tx.now)
        assert events.after(tx.session, 0) == []
    play.submit(1)
    with catalog.reading() as session:
        assert events.after(session, 0)[0].seq > last


def test_events_belong_to_the_project_of_what_they_happened_to(play, catalog) -> None:
    """Also those that a worker writes, whose catalog shows every project's rows."""
    with catalog.transaction() as tx:
        tx.session.add(ProjectRow(id="prj_other", name="other", created_at=tx.now))
    job = play.submit(1)
    worker = Catalog(catalog.url)
    with worker.transaction() as tx:
        workflow.cancel_job(tx, job)
        assert jobs.get(tx.session, job).project_id == "prj_default"
    worker.dispose()
    assert kinds(catalog, job) == ["job.queued", "job.cancelled"]
    assert kinds(catalog.scoped("prj_other")) == []


def test_a_reader_asks_for_kinds_and_pages(play, catalog) -> None:
    play.submit(3)
    play.finish_all()
    with catalog.reading() as session:
        scenes = events.after(session, 0, kinds={EventKind.SCENE_DONE})
        assert [event.kind for event in scenes] == ["scene.done"] * 3
        assert events.after(session, scenes[0].seq, kinds={EventKind.SCENE_DONE}, limit=1) == scenes[1:2]
        assert events.after(session, events.last_seq(session)) == []
