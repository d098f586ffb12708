"""What crashes, lost messages and impatient clients leave behind is put right, on both databases and a real Redis."""

import threading
from datetime import timedelta

import pytest
from sqlalchemy import select

from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Catalog,
    DriveState,
    JobState,
    QueueName,
    StageMessage,
    StageName,
    StageRow,
    StageState,
    UploadState,
    drives,
    uploads,
)
from l3ps_platform.catalog import stages as catalog_stages
from l3ps_platform.errors import QueueUnavailable
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings
from l3ps_platform.workflow import Reconciler, Retry, resending


def test_nothing_to_do(tidy, play) -> None:
    play.submit()
    assert tidy() == workflow.Report()


def test_a_dead_worker_s_stage_is_tried_again_and_the_job_succeeds(tidy, play, sent) -> None:
    job = play.submit(scenes=1)
    play.take(lease=-1)
    assert tidy(retry_seconds=0) == workflow.Report(expired=1, retried=1)
    assert [(m.name, m.attempt) for m in sent] == [("segment", 2)]
    assert play.finish_all() == ["segment", "refine", "publish"]
    assert play.job(job).state is JobState.SUCCEEDED


def test_a_stage_far_beyond_its_time_limit_is_not_held_by_its_lease(tidy, play, sent) -> None:
    """Its worker ought to have ended it at the limit and goes on to prolong its lease."""
    play.submit(scenes=1)
    claim = play.take(lease=3600.0)
    assert tidy(stage_seconds=3600.0, lease_seconds=0.0, train_seconds=0.001).hanging == 0
    assert tidy(stage_seconds=0.0, lease_seconds=0.0).hanging == 1
    stage = play.stage(claim.stage_id)
    assert (stage.state, stage.error["cause"]) == (StageState.WAITING, "timeout")
    assert "its worker did not stop it" in stage.error["message"]


def test_a_live_lease_is_left_alone(tidy, play, sent) -> None:
    play.submit(scenes=1)
    claim = play.take(lease=60)
    assert tidy().expired == 0
    assert play.stage(claim.stage_id).state is StageState.RUNNING


def test_a_dead_worker_of_a_cancelled_job_ends_it(tidy, play, sent) -> None:
    job = play.submit(scenes=1)
    play.take(lease=-1)
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    tidy()
    assert play.job(job).state is JobState.CANCELLED


def test_retries_wait_for_their_time(tidy, play, sent) -> None:
    play.submit(scenes=1)
    error = {"message": "the store was away", "problems": []}
    play.run(lambda tx, claim: workflow.fail(tx, claim, error, retry=Retry(3, 3600)))
    assert tidy().retried == 0
    play.submit(scenes=1)
    play.run(lambda tx, claim: workflow.fail(tx, claim, error, retry=Retry(3, 0)))
    assert tidy().retried == 1
    assert [(m.name, m.attempt) for m in sent] == [("segment", 2)]


def test_a_lost_message_is_sent_again_but_one_that_waits_is_not(tidy, play, sent) -> None:
    """Two stages are queued; the queue still holds the message of one of them."""
    play.submit(scenes=2)
    waiting, lost = sent
    sent.clear()
    tidy.queue.send([waiting])
    assert tidy(resend_seconds=3600).resent == 0
    assert tidy(resend_seconds=-1).resent == 1
    assert sent == [lost]


def test_a_lost_message_is_sent_again_behind_a_backlog_of_any_length(tidy, play, sent) -> None:
    """Nobody serves the queue `segment`; the message of a drive that came later never left the API."""
    play.submit(scenes=250)
    tidy.queue.send(sent)
    sent.clear()
    with play.catalog.transaction() as tx:
        workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="uploads/u/d.zip")
    (lost,) = sent
    sent.clear()
    assert tidy(resend_seconds=-1).resent == 1
    assert sent == [lost]


def test_many_lost_messages_leave_in_portions_and_each_once(tidy, play, sent, catalog, monkeypatch) -> None:
    monkeypatch.setattr(resending, "BATCH", 4)
    play.submit(scenes=10)
    lost = sent.copy()
    sent.clear()
    with catalog.transaction() as tx:
        for message in lost:
            catalog_stages.get(tx.session, message.stage_id).queued_at = tx.now - timedelta(minutes=1)
    resenders = [resending.Resender(catalog, tidy.queue, tidy.settings) for _ in range(2)]
    for resender in resenders:
        resender._look()  # both see all ten
    rounds = [resender.run_once() for _ in range(3) for resender in resenders]
    assert rounds == [4, 0, 4, 0, 2, 0]
    assert sorted(m.stage_id for m in sent) == [m.stage_id for m in lost]


def test_queues_are_read_when_something_is_overdue_and_no_more_often_than_messages_are_sent_again(
    tidy, play, catalog, monkeypatch
) -> None:
    reads = []
    pending = tidy.queue.pending
    monkeypatch.setattr(tidy.queue, "pending", lambda name: reads.append(name) or pending(name))
    reconciler = Reconciler(catalog, tidy.queue, tidy.settings)
    play.submit(scenes=1)
    assert (reconciler.run_once().resent, reads) == (0, [])
    with catalog.transaction() as tx:
        for stage in tx.session.scalars(select(StageRow).where(StageRow.state == StageState.QUEUED)):
            stage.queued_at = tx.now - timedelta(minutes=1)
    late = Reconciler(catalog, tidy.queue, tidy.settings)
    assert (late.run_once().resent, late.run_once().resent, reads) == (1, 0, ["segment"])


def test_a_drive_s_check_is_tried_again_too(tidy, play, sent) -> None:
    with play.catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="uploads/u/d.zip")
    tidy.store.put_bytes("uploads/u/d.zip", b"archive")
    crashed = workflow.failure("it was killed", workflow.Cause.CRASHED)
    for _ in range(3):
        play.run(lambda tx, claim: workflow.fail(tx, claim, crashed, retry=Retry(3, 0)))
        tidy()
    tidy.sweep()
    with play.catalog.reading() as session:
        row = drives.get(session, drive.id)
    assert row.state is DriveState.REJECTED
    assert row.problem["problems"][0]["code"] == "not-checked"
    assert row.object_key is None
    assert not tidy.store.exists("uploads/u/d.zip")


def test_a_drive_deleted_while_its_archive_is_swept_stays_deleted(tidy, play, monkeypatch, catalog: Catalog) -> None:
    rejected = play.drive(usable=False)
    delete = tidy.store.delete

    def meanwhile(key: str) -> None:
        with catalog.transaction() as tx:
            drives.delete(tx, rejected)
        delete(key)

    monkeypatch.setattr(tidy.store, "delete", meanwhile)
    assert tidy.sweep()["archives"] == 1
    with catalog.reading() as session:
        swept = drives.many(session, [rejected])[rejected]
    assert swept.deleted_at is not None and swept.object_key is None


def test_archives_of_rejected_and_deleted_drives_are_deleted(tidy, play, sent) -> None:
    rejected, deleted, kept = play.drive(usable=False), play.drive(), play.drive()
    for drive, key in ((rejected, "a/1"), (deleted, "a/2"), (kept, "a/3")):
        tidy.store.put_bytes(key, b"archive")
        with play.catalog.transaction() as tx:
            drives.lock(tx.session, drive).object_key = key
    with play.catalog.transaction() as tx:
        drives.delete(tx, deleted)
    assert tidy.sweep()["archives"] == 2
    assert [info.key for info in tidy.store.list()] == ["a/3"]
    assert tidy.sweep()["archives"] == 0


def test_abandoned_uploads_are_aborted(tidy, catalog: Catalog) -> None:
    """Their parts leave the store; a fresh one stays."""
    made = {}
    for name, seconds in (("old", -1), ("new", 3600)):
        upload_id = tidy.store.create_multipart(f"u/{name}", 5 << 20)
        with catalog.transaction() as tx:
            row = uploads.add(
                tx,
                kind="drive",
                filename=f"{name}.zip",
                size=1,
                parts=1,
                object_key=f"u/{name}",
                s3_upload_id=upload_id,
                seconds=seconds,
            )
        made[name] = (row.id, upload_id)
    assert tidy.sweep()["uploads"] == 1
    with catalog.reading() as session:
        assert uploads.get(session, made["old"][0]).state is UploadState.ABORTED
        assert uploads.get(session, made["new"][0]).state is UploadState.OPEN
    assert [p.name for p in (tidy.store.root / "multipart").iterdir()] == [made["new"][1]]


def test_two_reconcilers_at_once_send_one_message(tidy, play, sent) -> None:
    play.submit(scenes=10)
    for _ in range(10):
        play.take(lease=-1)
    barrier = threading.Barrier(3)

    def sweep() -> None:
        barrier.wait()
        tidy(retry_seconds=0)

    threads = [threading.Thread(target=sweep) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(m.attempt for m in sent) == [2] * 10
    assert len({m.stage_id for m in sent}) == 10


def test_a_worker_s_main_process_reports_its_dead_child(play, sent) -> None:
    """At once instead of after the lease, and only for stages of its own children."""
    play.submit(scenes=1)
    message = sent[0]
    claim = play.take(owner="host:100:101")
    retry = Retry(3, 5)
    with play.catalog.transaction() as tx:
        assert not workflow.lease_lost(tx, message.stage_id, retry, owner_prefix="host:999:")
        assert workflow.lease_lost(tx, message.stage_id, retry, owner_prefix="host:100:", reason="killed for memory")
    stage = play.stage(claim.stage_id)
    assert (stage.state, stage.attempt, stage.error["message"]) == (StageState.WAITING, 2, "killed for memory")


def test_a_dead_redis_is_said_so_and_the_row_stays_queued(catalog: Catalog, play) -> None:
    queue = Queue(Settings(redis_url="redis://127.0.0.1:1/0"))
    message = StageMessage("stg_x", 1, StageName.SEGMENT, QueueName.SEGMENT)
    for call in (queue.ping, queue.depth, lambda: queue.send([message])):
        with pytest.raises(QueueUnavailable, match="does not answer"):
            call()
    offline = Catalog(catalog.url, queue.send).scoped(DEFAULT_PROJECT)
    drive, model = play.drive(1), play.model()
    with offline.transaction() as tx:
        job = workflow.submit_job(tx, drive_id=drive, model=model)
    offline.dispose()
    assert play.states(job.id)[0] == ("segment", "queued")


def test_the_loop_stops_when_told(tidy, catalog: Catalog) -> None:
    stop = threading.Event()
    stop.set()
    Reconciler(catalog, tidy.queue, tidy.settings).run(stop)


def test_a_message_that_a_killed_worker_held_is_forgotten_when_its_stage_is_over(tidy, play, sent, redis_url) -> None:
    """Redis would deliver it again after a day; nobody acknowledges it before."""
    import json

    import redis

    job = play.submit(scenes=1)
    message = sent[0]
    tidy.queue.send([message])
    with redis.Redis.from_url(redis_url) as client:  # as kombu keeps what was delivered
        entry = json.dumps([json.loads(client.lpop(message.queue)), message.queue, message.queue])
        client.hset("unacked", "tag", entry)
        client.zadd("unacked_index", {"tag": 1.0})
        assert tidy.queue.delivered() == {"tag": (message.stage_id, 1)}
        assert tidy().spent == 0
        play.finish_all()
        assert play.job(job).state is JobState.SUCCEEDED
        assert tidy().spent == 1
        assert (client.hlen("unacked"), client.zcard("unacked_index")) == (0, 0)
