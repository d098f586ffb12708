"""What the service cannot do about one thing keeps it from nothing else; on both catalogs."""

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import JobRow, drives, retention, rules
from l3ps_platform.chore_metrics import ChoreCollector
from l3ps_platform.errors import QueueUnavailable, StoreUnavailable
from l3ps_platform.settings import Settings
from l3ps_platform.workflow import Reconciler, Sweeper, arrivals, expiry, reconcile, settle_arrivals, sweep
from l3ps_platform.workflow.chores import Chore


def test_a_lost_worker_s_stage_goes_on_though_another_one_s_cannot(tidy, play, catalog, monkeypatch) -> None:
    play.submit(scenes=3)
    claims = [play.take(lease=-1) for _ in range(3)]
    lease_lost = reconcile.lease_lost

    def refuse(tx, stage_id, *args, **more):
        if stage_id == claims[0].stage_id:
            raise ZeroDivisionError
        return lease_lost(tx, stage_id, *args, **more)

    monkeypatch.setattr(reconcile, "lease_lost", refuse)
    reconciler = Reconciler(catalog, tidy.queue, Settings(retry_seconds=0))
    assert (reconciler.run_once().expired, reconciler.chore.failures["expired"]) == (2, 1)
    monkeypatch.setattr(reconcile, "lease_lost", lease_lost)
    assert reconciler.run_once().expired == 1


def test_while_redis_is_away_leases_expire_and_jobs_arrive(tidy, play, catalog, monkeypatch) -> None:
    def away(*_: object) -> None:
        raise QueueUnavailable("away")

    play.submit(scenes=1)
    play.take(lease=-1)
    for name in ("pending", "delivered"):
        monkeypatch.setattr(tidy.queue, name, away)
    reconciler = Reconciler(catalog, tidy.queue, Settings(retry_seconds=0, resend_seconds=-1))
    assert reconciler.run_once() == workflow.Report(expired=1, retried=1)
    assert (reconciler.chore.failures["resent"], reconciler.chore.failures["spent"]) == (1, 1)


def test_what_the_store_refuses_to_delete_keeps_nothing_else_in_it(house, monkeypatch) -> None:
    """An object lock on the archives of more drives than a round has patience for, and on a job's manifest."""
    drives_ = [house.play.drive(usable=False) for _ in range(sweep.PATIENCE + 3)]
    locked = [f"locked/{id}" for id in drives_[:-1]]
    with house.catalog.transaction() as tx:
        for id, key in zip(drives_, [*locked, "free"], strict=True):
            drives.lock(tx.session, id).object_key = key
    first, second = house.job("a"), house.job("b")
    house.delete(first, second)
    delete = house.store.delete

    def refuse(key: str) -> None:
        if key.startswith(("locked/", f"jobs/{first}")):
            raise StoreUnavailable("the object store refused: AccessDenied")
        delete(key)

    monkeypatch.setattr(house.store, "delete", refuse)
    sweeper = Sweeper(house.catalog, house.store, Settings())
    rounds = [sweeper.run_once() for _ in range(2)]
    assert [done["archives"] for done in rounds] == [0, 1], "the free one is behind the locked ones"
    assert sum(done["jobs"] for done in rounds) == 1 and sum(done["outputs"] for done in rounds) == 4
    assert house.groups() == {f"jobs/{first}"}
    assert sweeper.chore.failures["archives"] == len(locked)
    monkeypatch.setattr(house.store, "delete", delete)
    assert sum(sweeper.run_once()["archives"] for _ in range(2)) == len(locked), "and nothing is forgotten"
    assert house.groups() == set()


def test_orphans_behind_one_that_is_refused_go(house, monkeypatch) -> None:
    for key in ("uploads/upl_a/file", "uploads/upl_b/file"):
        house.store.put_bytes(key, b"x")
    prefix = house.store.delete_prefix

    def refuse(prefix_: str) -> int:
        if "upl_a" in prefix_:
            raise StoreUnavailable("the object store refused: AccessDenied")
        return prefix(prefix_)

    monkeypatch.setattr(house.store, "delete_prefix", refuse)
    assert house.sweep(orphan_seconds=-1)["orphans"] == 1
    assert house.groups() == {"uploads/upl_a"}


def test_an_arrival_that_cannot_be_settled_keeps_those_behind_it_from_nothing(catalog, play, monkeypatch) -> None:
    model = play.model()
    with catalog.transaction() as tx:
        rule = rules.add(tx, name="r", bucket="b", prefix="", suffix=None, settings={"model": model})
        rules.note(tx, [(rule, str(n) * 64, f"log-{n}", f"s3://b/log-{n}") for n in range(3)])
    accept = arrivals.accept_source

    def refuse(tx, *, source: str):
        if source.endswith("log-0"):
            raise ZeroDivisionError
        return accept(tx, source=source)

    monkeypatch.setattr(arrivals, "accept_source", refuse)
    chore = Chore("test", "arrivals")
    assert (settle_arrivals(catalog, 60, 100, chore), chore.failures["arrivals"]) == (2, 1)
    with catalog.reading() as session:
        assert [row.key for row in rules.waiting(session)] == ["log-0"]
    monkeypatch.setattr(arrivals, "accept_source", accept)
    assert (settle_arrivals(catalog, 60, 100, chore), chore.failures["arrivals"]) == (1, 1)


@pytest.mark.parametrize("limits", [{"max_age_days": 1, "max_bytes": None}, {"max_age_days": None, "max_bytes": 0}])
def test_a_job_that_cannot_be_deleted_keeps_its_project_s_others_from_nothing(house, monkeypatch, limits) -> None:
    made = [house.job(name) for name in ("one", "two", "three")]
    for days, job in zip((9, 8, 7), made, strict=True):
        house.age(JobRow, job, days=days)
    with house.catalog.transaction() as tx:
        retention.put(tx, **limits)
    delete_job = expiry._delete_job

    def refuse(tx, id: str) -> None:
        if id == made[0]:
            raise ZeroDivisionError
        delete_job(tx, id)

    monkeypatch.setattr(expiry, "_delete_job", refuse)
    sweeper = Sweeper(house.catalog, house.store, Settings())
    sweeper.run_once()
    assert sweeper.chore.failures["expired_jobs"] == 1
    assert {key for key in house.groups() if key.startswith("jobs/")} == {f"jobs/{made[0]}"}


def test_what_failed_is_told_and_what_did_not_is_a_zero(house, monkeypatch) -> None:
    sweeper = Sweeper(house.catalog, house.store, Settings())
    monkeypatch.setattr(house.store, "delete_prefix", lambda _: 1 / 0)
    house.delete(house.job())
    sweeper.run_once()
    (family,) = ChoreCollector([sweeper.chore]).collect()
    told = {sample.labels["step"]: sample.value for sample in family.samples}
    assert (told["jobs"], told["outputs"], told["archives"]) == (1, 2, 0)
