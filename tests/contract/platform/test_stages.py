"""Who owns a stage, on SQLite and PostgreSQL: the rules that make lost and repeated messages harmless."""

import threading
from collections.abc import Callable

import pytest

from l3ps.errors import Cancelled
from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, JobState, StageMessage, StageState
from l3ps_platform.errors import LeaseLost
from l3ps_platform.workflow import Retry

RETRY = Retry(max_attempts=3, seconds=5.0)
ERROR = {"message": "it broke", "problems": []}


def test_a_job_runs_from_first_message_to_last(play, sent) -> None:
    job = play.submit(scenes=2)
    assert play.job(job).state is JobState.QUEUED
    assert play.finish_all() == ["segment", "segment", "refine", "refine", "publish"]
    row = play.job(job)
    assert row.state is JobState.SUCCEEDED
    assert row.quality == {"of": "publish"}
    assert row.started_at <= row.finished_at
    assert {state for _, state in play.states(job)} == {"done"}


def test_a_message_delivered_twice_is_claimed_once(play, sent) -> None:
    play.submit(scenes=1)
    message = sent[0]
    assert play.take(message) is not None
    assert play.take(message, owner="worker-2") is None


def test_a_message_delivered_after_its_stage_is_done_does_nothing(play, sent) -> None:
    job = play.submit(scenes=1)
    first = sent[0]
    play.finish_all()
    before = play.states(job)
    assert play.take(first) is None
    assert play.states(job) == before


def test_messages_for_unknown_stages_are_dropped(play, sent) -> None:
    play.submit(scenes=1)
    assert play.take(StageMessage("stg_none", 1, sent[0].name, sent[0].queue)) is None
    assert play.take(StageMessage(sent[0].stage_id, 7, sent[0].name, sent[0].queue)) is None


def test_many_claimers_at_once_get_each_stage_once(catalog: Catalog, play, sent) -> None:
    """Eight threads race for 20 stages, every one of them trying all."""
    play.submit(scenes=20)
    messages, won, barrier = list(sent), [], threading.Barrier(8)

    def race(owner: str) -> None:
        barrier.wait()
        for message in messages:
            claim = play.take(message, owner=owner)
            if claim is not None:
                won.append((claim.stage_id, owner))

    threads = [threading.Thread(target=race, args=(f"worker-{n}",)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(stage for stage, _ in won) == sorted(m.stage_id for m in messages)
    assert all(play.stage(stage).lease_owner == owner for stage, owner in won)


def test_scenes_finishing_at_once_publish_once(catalog: Catalog, play, sent) -> None:
    """Under PostgreSQL each of two transactions sees the other's scene still running unless the job is locked."""
    job = play.submit(scenes=6)
    while sent and sent[0].name == "segment":
        play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)))
    claims = [play.take() for _ in range(6)]
    barrier = threading.Barrier(6)

    def finish(claim: workflow.Claim) -> None:
        barrier.wait()
        with catalog.transaction() as tx:
            workflow.complete(tx, claim, workflow.Cost(1.0))

    threads = [threading.Thread(target=finish, args=(claim,)) for claim in claims]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [message.name for message in sent] == ["publish"]
    play.finish_all()
    assert play.job(job).state is JobState.SUCCEEDED


def test_who_lost_its_lease_may_not_write_any_more(play, sent, tidy) -> None:
    """A message redelivered after its worker died takes nothing over: that would tell nobody and wait for nothing."""
    play.submit(scenes=1)
    message = sent[0]
    dead = play.take(owner="dead", lease=-1)
    assert play.take(message, owner="alive") is None
    tidy(retry_seconds=0)
    claim = play.take(owner="alive")
    assert (claim.attempt, play.stage(claim.stage_id).lease_owner) == (2, "alive")
    for write in (
        lambda tx: workflow.report(tx, dead, "x", 1, 2, fraction=0.5),
        lambda tx: workflow.complete(tx, dead, workflow.Cost(1.0)),
        lambda tx: workflow.fail(tx, dead, ERROR, retry=RETRY),
        lambda tx: workflow.cancelled(tx, dead),
        lambda tx: workflow.release(tx, dead),
    ):
        with pytest.raises(LeaseLost), play.catalog.transaction() as tx:
            write(tx)
    stage = play.stage(claim.stage_id)
    assert (stage.state, stage.attempt, stage.lease_owner) == (StageState.RUNNING, 2, "alive")


@pytest.mark.parametrize("cancelled", [False, True], ids=["", "cancelled-meanwhile"])
def test_an_owner_may_claim_again_what_it_holds(play, sent, cancelled: bool) -> None:
    """The answer to its COMMIT was lost: only by asking again does it learn that the stage is its own."""
    job = play.submit(scenes=1)
    message = sent[0]
    claim = play.take(owner="worker-1")
    if cancelled:
        with play.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
    assert play.take(message, owner="worker-2") is None
    assert play.take(message, owner="worker-1") == claim


def test_workers_that_stop_together_do_not_wait_for_each_other_for_ever(catalog: Catalog, play, sent) -> None:
    """Each holds stages of the same jobs and gives them back, in an order of its own."""
    jobs = [play.submit(scenes=6) for _ in range(2)]
    for n, message in enumerate(list(sent)):
        play.take(message, owner=f"host:{n % 2}:x:1")
    given, barrier, errors = [], threading.Barrier(2), []

    def stop(worker: int) -> None:
        barrier.wait()
        try:
            given.append(workflow.release_owned(catalog, f"host:{worker}:"))
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=stop, args=(worker,)) for worker in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (given, errors) == ([6, 6], [])
    assert {state for job in jobs for name, state in play.states(job) if name == "segment"} == {"queued"}


def test_heartbeats_keep_a_stage(play, sent) -> None:
    play.submit(scenes=1)
    message = sent[0]
    claim = play.take(message, owner="host:1:2", lease=-1)
    with play.catalog.transaction() as tx:
        assert workflow.prolong(tx, "host:1:", lambda owner: owner == "host:1:2", 60.0) == 1
        assert not workflow.lease_lost(tx, claim.stage_id, RETRY, expired_before=tx.now)


def test_the_dead_and_the_neighbours_get_no_heartbeat(play, sent) -> None:
    play.submit(scenes=2)
    first, second = list(sent)
    play.take(first, owner="host:1:2", lease=-1)
    neighbour = play.take(second, owner="host:11:2", lease=-1)
    with play.catalog.transaction() as tx:
        assert workflow.prolong(tx, "host:1:", lambda owner: False, 60.0) == 0
        assert workflow.prolong(tx, "host:1:", lambda owner: True, 60.0) == 1
        assert workflow.lease_lost(tx, neighbour.stage_id, RETRY, expired_before=tx.now)


def test_progress_is_seen(play, sent) -> None:
    play.submit(scenes=1)
    claim = play.take()
    with play.catalog.transaction() as tx:
        workflow.report(tx, claim, "accumulate", 3, 20, fraction=0.15)
    stage = play.stage(claim.stage_id)
    assert (stage.progress_step, stage.progress_done, stage.progress_total, stage.fraction) == (
        "accumulate",
        3,
        20,
        0.15,
    )


def test_a_failure_is_tried_again_later_and_longer_each_time(play, sent) -> None:
    play.submit(scenes=1)
    message, waits = sent.pop(0), []
    for attempt in (1, 2):
        claim = play.take(StageMessage(message.stage_id, attempt, message.name, message.queue))
        with play.catalog.transaction() as tx:
            workflow.fail(tx, claim, ERROR, retry=RETRY)
            waits.append((tx.session.get(type(play.stage(claim.stage_id)), claim.stage_id).not_before - tx.now).seconds)
            workflow.planning.enqueue(tx, tx.session.get(type(play.stage(claim.stage_id)), claim.stage_id))
    assert waits == [5, 10]
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=RETRY), sent[-1])
    stage = play.stage(message.stage_id)
    assert (stage.state, stage.attempt, stage.error) == (StageState.FAILED, 3, ERROR)


def test_a_failed_scene_lets_the_others_finish(play, sent) -> None:
    job = play.submit(scenes=2)
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR))
    assert play.finish_all() == ["segment", "refine", "publish"]
    row = play.job(job)
    assert row.state is JobState.FAILED
    assert row.error["message"] == "1 of 2 scenes failed: scene-0: it broke"
    assert row.quality == {"of": "publish"}
    assert play.states(job)[:2] == [("segment", "failed"), ("refine", "cancelled")]


def test_a_job_whose_scenes_all_failed_publishes_nothing(play, sent) -> None:
    job = play.submit(scenes=2)
    for _ in range(2):
        play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR))
    assert not sent
    assert play.job(job).state is JobState.FAILED
    assert play.states(job)[-1] == ("publish", "cancelled")


def test_a_publish_that_fails_fails_the_job(play, sent) -> None:
    job = play.submit(scenes=1)
    play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)))
    play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)))
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR))
    row = play.job(job)
    assert (row.state, row.error["message"]) == (
        JobState.FAILED,
        "the results could not be published: publish: it broke",
    )


def test_a_worker_that_stops_gives_its_stage_back(play, sent) -> None:
    """No attempt is counted, and the next worker gets a message at once."""
    job = play.submit(scenes=1)
    play.run(workflow.release)
    assert (sent[0].name, sent[0].attempt) == ("segment", 1)
    play.finish_all()
    assert play.job(job).state is JobState.SUCCEEDED


class TestCancel:
    def test_before_anything_ran(self, play, sent) -> None:
        job = play.submit(scenes=2)
        with play.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
        assert play.job(job).state is JobState.CANCELLED
        assert {state for _, state in play.states(job)} == {"cancelled"}
        assert all(play.take(message) is None for message in sent)

    def test_a_running_stage_learns_of_it_at_its_next_report(self, play, sent) -> None:
        job = play.submit(scenes=2)
        claim = play.take()
        with play.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
        assert play.job(job).state is JobState.RUNNING
        with pytest.raises(Cancelled), play.catalog.transaction() as tx:
            workflow.report(tx, claim, "segment", 1, 6, fraction=0.2)
        with play.catalog.transaction() as tx:
            workflow.cancelled(tx, claim)
        assert play.job(job).state is JobState.CANCELLED
        assert play.job(job).finished_at is not None

    @pytest.mark.parametrize(
        "end",
        [
            lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)),
            lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=RETRY),
            workflow.release,
        ],
        ids=["done", "failed", "released"],
    )
    def test_however_the_running_stage_ends_the_job_is_cancelled(self, play, sent, end: Callable) -> None:
        job = play.submit(scenes=1)
        claim = play.take()
        with play.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
        with play.catalog.transaction() as tx:
            end(tx, claim)
        assert play.job(job).state is JobState.CANCELLED
        assert not sent

    def test_a_finished_job_stays_as_it_is(self, play, sent) -> None:
        job = play.submit(scenes=1)
        play.finish_all()
        with play.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
        assert play.job(job).state is JobState.SUCCEEDED

    def test_cancel_races_with_claims_without_deadlock(self, play, sent) -> None:
        """Claims hold stage rows and want the job's, cancel the other way round, unless they agree on an order."""
        job = play.submit(scenes=12)
        messages, barrier, errors = list(sent), threading.Barrier(4), []

        def guarded(action: Callable[[], None]) -> None:
            barrier.wait()
            try:
                action()
            except Exception as error:
                errors.append(error)

        def claim_all(owner: str) -> None:
            for message in messages:
                claim = play.take(message, owner=owner)
                if claim is not None:
                    with play.catalog.transaction() as tx:
                        workflow.complete(tx, claim, workflow.Cost(1.0))

        def cancel() -> None:
            with play.catalog.transaction() as tx:
                workflow.cancel_job(tx, job)

        actions = [lambda n=n: claim_all(f"worker-{n}") for n in range(3)] + [cancel]
        threads = [threading.Thread(target=guarded, args=(action,)) for action in actions]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not errors
        assert play.job(job).state is JobState.CANCELLED
        assert {state for _, state in play.states(job)} <= {"cancelled", "done"}
