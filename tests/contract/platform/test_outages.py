"""Outages use up no attempt, crashes do, on SQLite and PostgreSQL."""

import threading
from datetime import datetime, timedelta
from types import SimpleNamespace

from sqlalchemy.orm import Session

from l3ps.errors import Problem
from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, JobState, StageState, stages
from l3ps_platform.catalog import session as session_module
from l3ps_platform.errors import CatalogUnavailable
from l3ps_platform.workflow import Cause, Reconciler, Retry, failure, reconcile
from l3ps_platform.workflow.retries import next_try

AWAY = failure("the store is away", Cause.STORE_UNAVAILABLE)
CRASHED = failure("it was killed", Cause.CRASHED)
AT_ONCE = Retry(3, 0.0, longest_seconds=0.0)


def fail(play, error: dict, retry: Retry = AT_ONCE) -> str:
    """Fail the stage of the next message; the message of its next attempt is in ``sent`` if there is one."""
    message = play.sent[0]
    play.run(lambda tx, claim: workflow.fail(tx, claim, error, retry=retry))
    return message.stage_id


def test_an_outage_uses_up_no_attempt(play, sent, tidy) -> None:
    job = play.submit(scenes=1)
    for _ in range(5):
        stage = fail(play, AWAY)
        tidy()
    row = play.stage(stage)
    assert (row.attempt, row.failures, row.outage_seconds) == (6, 0, 5.0)
    for _ in range(2):
        fail(play, CRASHED)
        tidy()
    row = play.stage(stage)
    assert (row.attempt, row.failures, row.outage_seconds) == (8, 2, 0.0)
    assert row.error["cause"] == "crashed"
    play.finish_all()
    assert play.job(job).state is JobState.SUCCEEDED


def test_after_an_outage_a_stage_has_as_many_attempts_as_ever_and_no_more(play, sent, tidy) -> None:
    job = play.submit(scenes=1)
    for error in (CRASHED, AWAY, CRASHED, AWAY, CRASHED):
        fail(play, error)
        tidy()
    assert not sent
    assert play.job(job).state is JobState.FAILED


def test_an_outage_without_end_fails_with_its_cause(play, sent, tidy) -> None:
    job = play.submit(scenes=1)
    retry = Retry(3, 0.0, outage_seconds=3.0, longest_seconds=0.0)  # a try counts as a second at least
    for _ in range(3):
        stage = fail(play, AWAY, retry)
        assert play.stage(stage).state is StageState.WAITING
        tidy()
    fail(play, AWAY, retry)
    assert (play.stage(stage).state, play.stage(stage).error) == (StageState.FAILED, AWAY)
    assert "the store is away" in play.job(job).error["message"]


def test_the_waits_in_an_outage_double_up_to_a_bound(play, sent) -> None:
    play.submit(scenes=1)
    retry = Retry(3, 5.0, longest_seconds=60.0)
    with play.catalog.transaction() as tx:
        stage = stages.get(tx.session, sent[0].stage_id)
        stage.error = AWAY
        waits = [(next_try(tx, stage, retry) - tx.now).total_seconds() for _ in range(7)]
    assert waits == [5, 5, 10, 20, 40, 60, 60]


def test_what_lies_between_two_outages_is_no_outage(play, sent) -> None:
    """A stage may stand in a queue for hours, or run well, before what it stands on is away for a second time."""
    play.submit(scenes=1)
    retry = Retry(3, 5.0, outage_seconds=3600.0)
    with play.catalog.transaction() as tx:
        stage = stages.get(tx.session, sent[0].stage_id)
        stage.error = AWAY
        next_try(tx, stage, retry)
        tx.now += timedelta(hours=7)
        assert next_try(tx, stage, retry) is not None


def test_a_stage_may_lose_its_worker_more_often_than_fail(play, sent, tidy) -> None:
    """Nodes are drained and machines restarted; a scene that takes each of them down has an end all the same."""
    job = play.submit(scenes=1)
    fail(play, CRASHED)
    tidy()
    for lost in range(10):
        assert play.job(job).state is not JobState.FAILED, lost
        stage = play.take(lease=-1).stage_id
        tidy(retry_seconds=0.0)
    row = play.stage(stage)
    assert (row.state, row.failures, row.losses, row.error["cause"]) == (StageState.FAILED, 1, 10, "lease-lost")
    assert "stopped answering" in play.job(job).error["message"]


def test_leases_that_ran_out_unseen_are_borne_for_a_while(play, sent, tidy) -> None:
    """Who starts, or comes back to a catalog that was away, cannot know whether their owners could prolong them."""
    play.submit(scenes=2)
    held = play.take(lease=-1)
    message = sent[0]
    play.run(lambda tx, claim: workflow.fail(tx, claim, CRASHED, retry=Retry(3, 0.0)))
    settings = tidy.settings.model_copy(update={"reconcile_seconds": 0.01, "lease_seconds": 3600.0})
    stop = threading.Event()
    broom = threading.Thread(target=Reconciler(play.catalog, tidy.queue, settings).run, args=(stop,))
    broom.start()
    while play.stage(message.stage_id).state is not StageState.QUEUED:  # a round was made
        pass
    stop.set()
    broom.join()
    assert play.stage(held.stage_id).state is StageState.RUNNING
    assert tidy().expired == 1


def lost_after(reconciler: Reconciler, play) -> int:
    """How many lost workers a round of the reconciler notices."""
    play.submit(scenes=1)
    play.take(lease=-1)
    return reconciler.run_once().expired


def test_leases_are_borne_where_the_catalog_is_away_and_not_for_a_deadlock(play, sent, tidy, monkeypatch) -> None:
    def deadlock(*_: object) -> None:
        raise CatalogUnavailable("deadlock detected")

    monkeypatch.setattr(reconcile, "settle_arrivals", deadlock)
    reconciler = Reconciler(play.catalog, tidy.queue, tidy.settings)
    reconciler.run_once()
    assert (lost_after(reconciler, play), reconciler.chore.failures["arrivals"]) == (1, 2)
    monkeypatch.setattr(Catalog, "ping", deadlock)
    reconciler.run_once()
    assert lost_after(reconciler, play) == 0


def test_leases_are_borne_after_a_catalog_that_was_silent(play, sent, tidy, monkeypatch) -> None:
    """It answers in the end, and its clock has gone on: leases ran out that nobody could prolong."""
    clock, now = [0.0], Catalog.now
    monkeypatch.setattr(session_module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    reconciler = Reconciler(play.catalog, tidy.queue, tidy.settings)
    assert lost_after(reconciler, play) == 1

    def silent(catalog: Catalog, session: Session) -> datetime:
        clock[0] += tidy.settings.lease_seconds / 2
        return now(catalog, session)

    monkeypatch.setattr(Catalog, "now", silent)
    assert lost_after(reconciler, play) == 0, "of the very answer that was late"
    monkeypatch.setattr(Catalog, "now", now)
    assert reconciler.run_once().expired == 0
    assert tidy().expired == 1


def test_a_rejected_upload_s_check_says_that_it_did_its_work(play, sent) -> None:
    with play.catalog.transaction() as tx:
        workflow.accept_drive(tx, name="d", filename="d.zip", size=9, object_key="uploads/u/d.zip")
    problem = Problem("no-log", "d.zip", "it holds no drive log", "Pack another.")
    message = sent[0]
    play.run(lambda tx, claim: workflow.drive_checked(tx, claim, workflow.Cost(1.0), usable=False, problems=[problem]))
    stage = play.stage(message.stage_id)
    assert (stage.state, stage.error["cause"]) == (StageState.DONE, "bad-input")
    assert stage.error["message"].startswith("the check is done and the upload is rejected: d.zip: it holds no drive")


def test_a_cancel_that_comes_when_the_results_are_out_comes_too_late(play, sent) -> None:
    job = play.submit(scenes=1)
    for _ in range(2):
        play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)))
    claim = play.take()
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    with play.catalog.transaction() as tx:
        workflow.complete(tx, claim, workflow.Cost(1.0), output_key="jobs/x/manifest.json")
    assert play.job(job).state is JobState.SUCCEEDED


def test_what_was_cancelled_says_so(play, sent) -> None:
    job = play.submit(scenes=1)
    claim = play.take()
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    with play.catalog.transaction() as tx:
        assert workflow.lease_lost(tx, claim.stage_id, Retry(3, 0.0), reason="killed", cause=Cause.CRASHED)
    stage = play.stage(claim.stage_id)
    assert (stage.state, stage.error["cause"]) == (StageState.CANCELLED, "cancelled")
