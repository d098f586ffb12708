"""Webhooks' deliveries: made with the event, taken by one, given up in the end; on both databases."""

import json
import threading
from datetime import datetime, timedelta

import pytest
from sqlalchemy import text

from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, DeliveryRow, DeliveryState, ProjectRow, WebhookRow, events, webhooks
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.ids import new_id
from l3ps_platform.workflow import deliveries
from l3ps_platform.workflow.deliveries import Attempt, Parcel

pytestmark = pytest.mark.services
DAYS = timedelta(days=5)
TAKEN = Attempt(200, None, 0.1)
REFUSED = Attempt(500, "the receiver answered 500", 0.1, again_after=timedelta())
LAST = Attempt(500, "the receiver answered 500", 0.1)
GONE = Attempt(410, "the receiver answered 410", 0.1, again_after=timedelta(), gone=True)


class Post:
    """Webhooks of a catalog, and deliverers that the test plays."""

    def __init__(self, catalog: Catalog) -> None:
        self.catalog = catalog

    def hook(self, *kinds: str, **fields) -> str:
        values = {"url": "https://hooks.example/x", "secret": "whsec_AAAA", "enabled": True, "events": list(kinds)}
        with self.catalog.transaction() as tx:
            row = WebhookRow(id=new_id("whk"), created_at=tx.now, **(values | fields))
            tx.session.add(row)
        return row.id

    def ping(self, hook: str, count: int = 1) -> list[str]:
        with self.catalog.transaction() as tx:
            return [deliveries.ping(tx, webhooks.lock(tx.session, hook)).id for _ in range(count)]

    def take(self, limit: int = 100, owner: str = "one", lease: float = 60, share: int = 100) -> list[Parcel]:
        with self.catalog.transaction() as tx:
            return deliveries.take(tx, owner, limit=limit, share=share, lease_seconds=lease)

    def end(self, parcel: Parcel, attempt: Attempt) -> None:
        with self.catalog.transaction() as tx:
            deliveries.attempted(tx, parcel, attempt, disable_after=DAYS)

    def rows(self, hook: str) -> list[DeliveryRow]:
        with self.catalog.reading() as session:
            return webhooks.deliveries(session, hook, limit=1000, before=None)[::-1]

    def states(self, hook: str) -> list[str]:
        return [row.state.value for row in self.rows(hook)]

    def get(self, hook: str) -> WebhookRow:
        with self.catalog.reading() as session:
            return webhooks.get(session, hook)


@pytest.fixture
def post(catalog: Catalog) -> Post:
    return Post(catalog)


def test_each_webhook_gets_what_it_asked_for_with_the_event(post, play) -> None:
    everything, ends, off = post.hook(), post.hook("job.succeeded", "scene.*"), post.hook(enabled=False)
    play.submit(scenes=1)
    play.finish_all()
    told = [row.kind for row in post.rows(everything)]
    assert told == ["drive.ready", "model.ready", "job.queued", "job.running", "scene.done", "job.succeeded"]
    assert [row.kind for row in post.rows(ends)] == ["scene.done", "job.succeeded"]
    assert post.rows(off) == []
    with post.catalog.reading() as session:
        logged = {event.seq: event for event in events.after(session, 0)}
    for row in post.rows(everything):
        body = json.loads(row.body)
        assert set(body) == {"type", "timestamp", "data"}
        assert (body["type"], body["data"]) == (logged[row.seq].kind, logged[row.seq].data)


def test_nothing_is_to_be_delivered_of_what_was_rolled_back(post, play) -> None:
    hook, job = post.hook("job.cancelled"), play.submit()
    with pytest.raises(ZeroDivisionError), post.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
        raise ZeroDivisionError
    assert post.rows(hook) == []


def test_another_project_s_webhooks_are_told_nothing(post, play, catalog) -> None:
    with catalog.transaction() as tx:
        tx.session.add(ProjectRow(id="prj_other", name="other", created_at=tx.now))
    theirs = Post(catalog.scoped("prj_other"))
    hook = theirs.hook()
    play.submit()
    assert theirs.rows(hook) == []
    with pytest.raises(NotFound):
        post.get(hook)


def test_a_delivery_is_in_one_pair_of_hands(post) -> None:
    hooks = [post.hook() for _ in range(6)]
    for hook in hooks:
        post.ping(hook, 3)
    barrier, taken = threading.Barrier(3), []

    def work(owner: str) -> None:
        barrier.wait()
        taken.extend((owner, parcel.id) for parcel in post.take(limit=9, owner=owner))

    threads = [threading.Thread(target=work, args=(f"deliverer-{n}",)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(taken) == len({id for _, id in taken}) == 18


def test_one_webhook_gets_four_at_a_time_from_all_deliverers_together(post) -> None:
    hook = post.hook()
    post.ping(hook, 10)
    first = post.take(limit=3, owner="one")
    second = post.take(owner="two")
    assert (len(first), len(second)) == (3, 1)
    assert post.take(owner="three") == []
    post.end(first[0], TAKEN)
    assert len(post.take(owner="three")) == 1


def test_a_busy_webhook_does_not_keep_others_waiting(post) -> None:
    busy, quiet = post.hook(), post.hook()
    post.ping(busy, 20)
    post.ping(quiet, 1)
    assert {parcel.webhook_id for parcel in post.take(limit=2)} == {busy, quiet}


TIMED_OUT = Attempt(None, "no complete answer within 15 s", 15.0, again_after=timedelta(), timed_out=True)


@pytest.fixture
def others(catalog, post) -> Post:
    """The same in another project."""
    with catalog.transaction() as tx:
        tx.session.add(ProjectRow(id="prj_other", name="other", created_at=tx.now))
    return Post(catalog.scoped("prj_other"))


def test_a_project_whose_receivers_hang_leaves_room_for_others(post, others) -> None:
    """Fifty of them, with a backlog each: another project's only message is the next to go."""
    everything = Post(post.catalog.whole())
    for _ in range(50):
        post.ping(post.hook(), 4)
    assert len(everything.take(limit=16, share=8)) == 8, "places stay free for whoever comes"
    quiet = others.hook()
    others.ping(quiet)
    assert [parcel.webhook_id for parcel in everything.take(limit=1, share=8)] == [quiet]
    assert everything.take(limit=8, share=8) == []
    assert len(everything.take(limit=16, share=8, owner="another process")) == 8


def test_projects_take_turns_and_the_one_with_less_under_way_is_first(post, others) -> None:
    everything = Post(post.catalog.whole())
    busy, quiet = [post.hook() for _ in range(3)], others.hook()
    for hook in busy:
        post.ping(hook, 2)
    others.ping(quiet, 3)
    taken = [everything.take(limit=1)[0].webhook_id for _ in range(6)]
    assert [hook == quiet for hook in taken].count(True) == 3
    assert set(taken) - {quiet} == set(busy), "and within a project its webhooks do"


def test_a_webhook_whose_last_turn_is_longest_ago_is_next(post) -> None:
    hooks = [post.hook() for _ in range(3)]
    for hook in hooks:
        post.ping(hook, 3)
    turns = []
    for _ in range(6):
        (parcel,) = post.take(limit=1)
        turns.append(parcel.webhook_id)
        post.end(parcel, REFUSED)
    assert turns[:3] == turns[3:] and set(turns) == set(hooks)


def test_a_receiver_that_times_out_is_left_alone_longer_and_longer_and_then_asked_once(post, catalog) -> None:
    hook = post.hook()
    post.ping(hook, 6)
    for parcel in post.take():
        post.end(parcel, TIMED_OUT)
    assert post.take() == []

    def pause() -> tuple[timedelta, timedelta]:
        """Of the last attempt: the pause, and how long nothing had been delivered then."""
        row = post.get(hook)
        at = max(datetime.fromisoformat(entry["at"]) for delivery in post.rows(hook) for entry in delivery.log)
        return row.paused_until - at, at - row.failing_since

    assert pause()[0] == timedelta(seconds=15)
    for failing in (timedelta(minutes=3), timedelta(days=1)):
        with catalog.transaction() as tx:
            row = webhooks.lock(tx.session, hook)
            row.failing_since, row.paused_until = tx.now - failing, tx.now
        (probe,) = post.take()
        post.end(probe, TIMED_OUT)
        paused, lasted = pause()
        assert paused == min(lasted, deliveries.LONGEST_PAUSE)
    with catalog.transaction() as tx:
        webhooks.lock(tx.session, hook).paused_until = tx.now
    (probe,) = post.take()
    post.end(probe, TAKEN)
    assert post.get(hook).paused_until is None and len(post.take()) == deliveries.PER_WEBHOOK


def test_a_receiver_that_refuses_at_once_is_not_left_alone(post) -> None:
    hook = post.hook()
    post.ping(hook, 2)
    first, second = post.take()
    post.end(first, TIMED_OUT)
    post.end(second, REFUSED)
    assert len(post.take()) == 2


def test_a_long_backlog_of_a_webhook_that_is_switched_off_fails_in_portions(post, monkeypatch) -> None:
    monkeypatch.setattr(deliveries, "BATCH", 2)
    hook, other = post.hook(), post.hook()
    post.ping(hook, 5)
    post.ping(other, 2)
    with post.catalog.transaction() as tx:
        for row in tx.session.query(DeliveryRow).filter_by(webhook_id=hook):
            row.next_at += timedelta(days=1)
        deliveries.disable(tx, webhooks.lock(tx.session, hook), "on request")
    assert post.states(hook).count("failed") == 2
    taken = [parcel.webhook_id for _ in range(4) for parcel in post.take(limit=1)]
    assert post.states(hook) == ["failed"] * 5 and taken == [other, other]


def test_a_webhook_is_deleted_in_portions_and_events_do_not_wait_for_it(post, play, catalog, monkeypatch) -> None:
    """Whoever writes an event holds a lock that all who do so need."""
    monkeypatch.setattr(deliveries, "BATCH", 2)
    hook, job = post.hook(), play.submit()
    post.ping(hook, 5)
    forget, portions = webhooks.forget_deliveries, []

    def meanwhile(session, id: str, limit: int) -> int:
        gone = forget(session, id, limit)
        portions.append(gone)
        if len(portions) == 1 and catalog.engine.dialect.name == "postgresql":  # SQLite has one writer
            with catalog.transaction() as tx:
                workflow.cancel_job(tx, job)
        return gone

    monkeypatch.setattr(webhooks, "forget_deliveries", meanwhile)
    deliveries.forget(catalog, hook)
    assert set(portions[:-1]) <= {1, 2} and sum(portions) >= 5
    assert post.rows(hook) == []
    with pytest.raises(NotFound):
        deliveries.forget(catalog, hook)


def test_what_a_dead_deliverer_held_is_made_again_under_the_same_id(post) -> None:
    hook = post.hook()
    (id,) = post.ping(hook)
    (dead,) = post.take(owner="dead", lease=-1)
    (again,) = post.take(owner="alive")
    assert dead.id == again.id == id and again.attempts == 0
    post.end(dead, LAST)  # it was not dead but slow: no longer its business
    assert post.states(hook) == ["pending"]
    post.end(again, TAKEN)
    (row,) = post.rows(hook)
    assert (row.state, row.attempt, len(row.log)) == (DeliveryState.DELIVERED, 1, 1)


def test_what_is_put_back_is_due_at_once_and_no_attempt(post) -> None:
    hook = post.hook()
    post.ping(hook)
    parcels = post.take(owner="one")
    with post.catalog.transaction() as tx:
        deliveries.put_back(tx, parcels)
    (again,) = post.take(owner="two")
    assert again.attempts == 0


def test_whoever_puts_back_waits_for_who_holds_the_webhook(post) -> None:
    hook = post.hook()
    post.ping(hook, 2)
    parcels = post.take(owner="one")

    def put_back() -> None:
        with post.catalog.transaction() as tx:
            deliveries.put_back(tx, parcels)

    thread = threading.Thread(target=put_back)
    with post.catalog.transaction() as tx:
        webhooks.lock(tx.session, hook)
        thread.start()
        while thread.is_alive() and post.catalog.engine.dialect.name == "postgresql":
            with post.catalog.reading() as session:
                if session.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted")):
                    break
        assert thread.is_alive()
    thread.join()
    assert len(post.take(owner="two")) == 2


def test_failures_are_logged_and_the_last_one_is_final(post) -> None:
    hook = post.hook()
    post.ping(hook)
    for attempt in (REFUSED, REFUSED, LAST):
        (parcel,) = post.take()
        post.end(parcel, attempt)
    (row,) = post.rows(hook)
    assert (row.state, row.attempt, row.last_status) == (DeliveryState.FAILED, 3, 500)
    assert [entry["status"] for entry in row.log] == [500] * 3
    assert post.take() == []
    assert post.get(hook).enabled and post.get(hook).failing_since is not None


def test_the_log_is_bounded(post) -> None:
    hook = post.hook()
    post.ping(hook)
    for _ in range(deliveries.KEPT_ATTEMPTS + 5):
        (parcel,) = post.take()
        post.end(parcel, REFUSED)
    (row,) = post.rows(hook)
    assert (row.attempt, len(row.log)) == (deliveries.KEPT_ATTEMPTS + 5, deliveries.KEPT_ATTEMPTS)


def test_a_wait_is_waited(post) -> None:
    hook = post.hook()
    post.ping(hook)
    (parcel,) = post.take()
    post.end(parcel, Attempt(503, "busy", 0.1, again_after=timedelta(hours=1)))
    assert post.take() == []
    (row,) = post.rows(hook)
    assert timedelta(minutes=59) < row.next_at - row.created_at < timedelta(minutes=61)


def test_410_switches_a_webhook_off_and_says_so(post) -> None:
    hook, watcher = post.hook(), post.hook("webhook.disabled")
    post.ping(hook, 3)
    first, second, _ = post.take()
    post.end(first, GONE)
    assert not post.get(hook).enabled and "410" in post.get(hook).disabled_reason
    (told,) = post.rows(watcher)
    data = json.loads(told.body)["data"]
    assert data == {"id": hook, "reason": post.get(hook).disabled_reason}, "a URL may be a secret"
    with pytest.raises(Conflict, match="switched off"):
        post.ping(hook)
    post.end(second, REFUSED)  # was under way: it is not tried again
    assert post.states(hook)[:2] == ["failed", "failed"]


def test_what_waits_for_a_webhook_that_is_switched_off_fails_and_can_be_replayed(post, monkeypatch) -> None:
    hook = post.hook()
    ids = post.ping(hook, 2)
    with post.catalog.transaction() as tx:
        row = webhooks.lock(tx.session, hook)
        deliveries.disable(tx, row, "on request")
    assert post.states(hook) == ["failed", "failed"] and post.take() == []
    with post.catalog.transaction() as tx:
        since = tx.now - timedelta(hours=1)
    with pytest.raises(Conflict, match="switched off"):
        deliveries.replay_failed(post.catalog, hook, since)
    with post.catalog.transaction() as tx:
        deliveries.enable(webhooks.lock(tx.session, hook))
    monkeypatch.setattr(deliveries, "BATCH", 1)
    assert deliveries.replay_failed(post.catalog, hook, since + timedelta(hours=2)) == 0
    assert deliveries.replay_failed(post.catalog, hook, since) == 2
    assert deliveries.replay_failed(post.catalog, hook, since) == 0
    assert sorted(parcel.id for parcel in post.take()) == sorted(ids)


def test_what_is_held_for_a_webhook_that_is_switched_off_is_not_stuck_if_its_deliverer_dies(post) -> None:
    hook = post.hook()
    post.ping(hook)
    post.take(owner="dead", lease=-1)
    with post.catalog.transaction() as tx:
        deliveries.disable(tx, webhooks.lock(tx.session, hook), "on request")
    assert post.take(owner="alive") == []
    assert post.states(hook) == ["failed"]


def test_a_webhook_that_takes_nothing_for_five_days_is_switched_off(post) -> None:
    hook = post.hook()
    post.ping(hook, 2)
    first, second = post.take()
    post.end(first, REFUSED)
    assert post.get(hook).enabled
    with post.catalog.transaction() as tx:
        webhooks.lock(tx.session, hook).failing_since = tx.now - DAYS
    post.end(second, REFUSED)
    assert not post.get(hook).enabled and "nothing was delivered since" in post.get(hook).disabled_reason
    assert post.states(hook) == ["failed", "failed"]


def test_one_success_clears_the_record(post) -> None:
    hook = post.hook(failing_since=None)
    post.ping(hook, 2)
    first, second = post.take()
    post.end(first, LAST)
    post.end(second, TAKEN)
    assert post.get(hook).failing_since is None


def test_two_secrets_sign_while_they_overlap(post) -> None:
    with post.catalog.transaction() as tx:
        now = tx.now
    old = {"secret": "whsec_BBBB", "previous_secret": "whsec_AAAA"}
    overlapping, over = (
        post.hook(**old, previous_until=now + timedelta(hours=1)),
        post.hook(**old, previous_until=now - timedelta(seconds=1)),
    )
    for hook in (overlapping, over):
        post.ping(hook)
    secrets = {parcel.webhook_id: parcel.secrets for parcel in post.take()}
    assert secrets == {overlapping: ("whsec_BBBB", "whsec_AAAA"), over: ("whsec_BBBB",)}


def test_a_webhook_deleted_meanwhile_breaks_nothing(post, play, catalog) -> None:
    """Neither the deliverer that holds a delivery, nor a transaction that is about to make one."""
    hook = post.hook()
    post.ping(hook)
    (parcel,) = post.take()
    job = play.submit()
    deleting, deleted = threading.Event(), threading.Event()

    def delete() -> None:
        with catalog.transaction() as tx:
            tx.session.delete(webhooks.get(tx.session, hook))
            tx.session.flush()
            deleting.set()
            deleted.wait(0.3)  # the others come to the row in this time

    def cancel() -> None:
        deleting.wait()
        with catalog.transaction() as tx:
            workflow.cancel_job(tx, job)
        deleted.set()

    threads = [threading.Thread(target=work) for work in (delete, cancel)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert play.job(job).state == "cancelled"
    with pytest.raises(NotFound):
        post.end(parcel, TAKEN)
    assert post.take() == [] and post.rows(hook) == []


def test_what_is_over_and_old_is_forgotten_and_what_is_pending_is_kept(post) -> None:
    hook = post.hook()
    post.ping(hook, 2)
    post.end(post.take(limit=1)[0], TAKEN)
    with post.catalog.transaction() as tx:
        webhooks.prune_deliveries(tx.session, tx.now + timedelta(seconds=1))
    assert post.states(hook) == ["pending"]
