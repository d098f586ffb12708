"""What is deleted goes from the store, what anybody needs stays; on both databases, with real threads."""

import os
import threading
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select, text

from l3ps_platform import workflow
from l3ps_platform.catalog import (
    AnnotationsRow,
    Catalog,
    DriveRow,
    JobRow,
    JobState,
    OutputRow,
    ProjectRow,
    TrainingRow,
    UploadRow,
    UploadState,
    bundles,
    drives,
    jobs,
    outputs,
    retention,
    rules,
    uploads,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.catalog.source_rows import ArrivalRow
from l3ps_platform.errors import Conflict, LeaseLost, NotFound, OutputDoomed, StoreUnavailable
from l3ps_platform.objects import DirectoryStore
from l3ps_platform.settings import Settings
from l3ps_platform.workflow import sweep

PROJECT = "prj_default"


def stage_keys(content: str) -> set[str]:
    return {f"stages/{PROJECT}/segment-{content}", f"stages/{PROJECT}/refine-{content}"}


def test_a_deleted_job_leaves_nothing_in_the_store_but_stays_in_the_figures(house) -> None:
    job = house.job()
    assert house.groups() == stage_keys("a") | {f"jobs/{job}"}
    house.delete(job)
    with house.catalog.reading() as session:
        with pytest.raises(NotFound):
            jobs.get(session, job)
        assert jobs.page(session) == []
        assert session.get(JobRow, job).quality is None and len(jobs.scenes(session, job)) == 1
    assert house.sweep()["outputs"] == 2
    assert house.groups() == set()
    with house.catalog.reading() as session:
        assert outputs.doomed(session, 10) == [] and session.get(OutputRow, f"stages/{PROJECT}/refine-a") is None
    assert house.sweep()["jobs"] == 0


def test_what_another_job_uses_too_stays_until_that_is_gone_as_well(house) -> None:
    first, second = house.job("shared"), house.job("shared")
    house.delete(first)
    house.sweep()
    assert house.groups() == stage_keys("shared") | {f"jobs/{second}"}
    house.delete(second)
    house.sweep()
    assert house.groups() == set()


def test_what_an_unfinished_job_has_pinned_stays(house) -> None:
    old = house.job("same")
    house.play.submit(scenes=1)
    claim = house.play.take()
    house.pin(claim, f"stages/{PROJECT}/segment-same")
    house.delete(old)
    house.sweep()
    assert house.groups() == {f"stages/{PROJECT}/segment-same"}
    house.end(claim, f"stages/{PROJECT}/segment-same/primal.npz")


def test_only_a_job_that_is_over_can_be_deleted_and_only_once(house) -> None:
    job = house.play.submit(scenes=1)
    with pytest.raises(Conflict, match="cancel it first"):
        house.delete(job)
    house.finish("x")
    house.delete(job)
    with pytest.raises(NotFound):
        house.delete(job)


def test_a_doomed_output_is_refused_until_it_is_gone_and_then_made_anew(house) -> None:
    house.delete(house.job("d"))
    house.store.delete_prefix = _away  # the store goes away between the two halves of the deletion
    assert house.sweep()["outputs"] == 0
    del house.store.delete_prefix
    house.play.submit(scenes=1)
    claim = house.play.take()
    key = f"stages/{PROJECT}/segment-d"
    with house.catalog.transaction() as tx:
        workflow.doom_output(tx, key)
    with pytest.raises(OutputDoomed):
        house.pin(claim, key)
    house.sweep()
    house.pin(claim, key)
    assert not house.store.exists(f"{key}/primal.npz"), "what is pinned now is empty, not half"


def _away(_: str) -> int:
    raise StoreUnavailable("away")


def test_a_stage_that_was_lost_pins_nothing(house) -> None:
    house.play.submit(scenes=1)
    claim = house.play.take()
    with house.catalog.transaction() as tx:
        workflow.release(tx, claim)
    with pytest.raises(LeaseLost):
        house.pin(claim, f"stages/{PROJECT}/segment-x")


def test_pinning_and_dooming_at_once_never_lose_an_output(house) -> None:
    """Whoever comes second sees the first: a pin that succeeded finds everything there or nothing, and keeps it."""
    key = f"stages/{PROJECT}/segment-r"
    outcomes = set()
    for _ in range(6):
        old = house.job("r")
        house.play.submit(scenes=1)
        claim = house.play.take()
        house.delete(old)
        barrier = threading.Barrier(3)
        seen: dict[str, object] = {}

        def work(claim=claim, barrier=barrier, seen=seen) -> None:
            barrier.wait()
            while True:
                try:
                    house.pin(claim, key)
                    break
                except OutputDoomed:
                    seen["refused"] = True
            seen["cached"] = house.store.exists(f"{key}/primal.npz")
            if not seen["cached"]:
                house.store.put_bytes(f"{key}/part-1.bin", b"x" * 100)
            house.end(claim, f"{key}/primal.npz")

        def sweep(barrier=barrier) -> None:
            barrier.wait()
            for _ in range(3):
                house.sweep()

        threads = [threading.Thread(target=target) for target in (work, sweep, sweep)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert {info.key for info in house.store.list(f"{key}/")} == {f"{key}/part-1.bin", f"{key}/primal.npz"}, seen
        outcomes.add((seen["cached"], "refused" in seen))
        house.finish("r")
    assert outcomes


def blocked_or_over(catalog: Catalog, thread: threading.Thread) -> None:
    """Wait until a thread's transaction waits for a lock, or did not have to."""
    while thread.is_alive() and catalog.engine.dialect.name == "postgresql":
        with catalog.reading() as session:
            if session.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted")):
                return


@pytest.mark.parametrize("first", ["pin", "doom"])
def test_of_two_that_meet_the_second_waits_and_sees_what_the_first_did(house, first: str) -> None:
    key = f"stages/{PROJECT}/segment-m"
    house.delete(house.job("m"))
    house.play.submit(scenes=1)
    claim = house.play.take()
    seen = []

    def act(tx, name: str) -> None:
        try:
            seen.append((name, workflow.pin_output(tx, claim, key) if name == "pin" else workflow.doom_output(tx, key)))
        except OutputDoomed:
            seen.append((name, "refused"))

    def second() -> None:
        with house.catalog.transaction() as tx:
            act(tx, "doom" if first == "pin" else "pin")

    thread = threading.Thread(target=second)
    with house.catalog.transaction() as tx:
        act(tx, first)
        thread.start()
        blocked_or_over(house.catalog, thread)
    thread.join()
    assert seen == ([("pin", None), ("doom", False)] if first == "pin" else [("doom", True), ("pin", "refused")])


def test_a_model_is_deleted_with_its_archive_and_its_name_is_free(house) -> None:
    job = house.job()
    with house.catalog.reading() as session:
        model, drive = jobs.get(session, job).model_id, jobs.get(session, job).drive_id
        name = bundles.get(session, model).name
    house.store.put_bytes("uploads/u/m.zip", b"model")
    busy = house.play.submit(scenes=1)
    with house.catalog.reading() as session:
        used = jobs.get(session, busy).model_id
    with pytest.raises(Conflict, match="is used by job"), house.catalog.transaction() as tx:
        bundles.delete(tx, used)
    with house.catalog.transaction() as tx:
        bundles.delete(tx, model)
        with pytest.raises(NotFound):
            workflow.submit_job(tx, drive_id=drive, model=model)
        assert bundles.named(tx.session, name) is None
    house.sweep()
    assert "uploads/u" not in house.groups()
    with house.catalog.reading() as session:
        assert jobs.get(session, job).model_id == model, "labels made with it stay"


def test_what_nobody_owns_goes_after_a_day_and_what_somebody_owns_stays(house) -> None:
    job = house.job()
    orphans = {
        f"stages/{PROJECT}/refine-dead",
        "stages/prj_gone/segment-x",
        "uploads/upl_x",
        "jobs/job_x",
        "trainings/trn_x",
    }
    for key in orphans:
        house.store.put_bytes(f"{key}/file", b"x")
    lost = house.store.create_multipart("uploads/upl_y/archive", 5 << 20)
    house.sweep()
    house.sweep()
    assert house.groups() == orphans | stage_keys("a") | {f"jobs/{job}"}, "it may be somebody's in a moment"
    for path in house.store.root.rglob("*"):
        os.utime(path, (0, 0))
    house.sweep()
    house.sweep()
    assert house.groups() == stage_keys("a") | {f"jobs/{job}"}
    assert lost not in {pending.upload_id for pending in house.store.list_multipart()}


def test_what_lies_among_the_outputs_and_is_none_goes_too(house) -> None:
    job = house.job()
    for key in (f"stages/{PROJECT}/notes/x", "stages/old-notes/x"):
        house.store.put_bytes(key, b"x")
    house.store.put_bytes(f"stages/{PROJECT}/file", b"in no folder: not of the sweep")
    sweeper = workflow.Sweeper(house.catalog, house.store, Settings(orphan_seconds=-1))
    assert sweeper.run_once()["orphans"] == 2
    assert sweeper.chore.failures["orphans"] == 0
    assert house.groups() == stage_keys("a") | {f"jobs/{job}", f"stages/{PROJECT}"}


def test_retention_by_age_takes_the_old_and_nothing_that_is_in_use(house) -> None:
    old, new = house.job("old"), house.job("new")
    with house.catalog.transaction() as tx:
        retention.put(tx, max_age_days=30, max_bytes=None)
    house.age(JobRow, old, days=31)
    with house.catalog.reading() as session:
        old_drive, new_drive = (jobs.get(session, id).drive_id for id in (old, new))
    for drive in (old_drive, new_drive):
        house.age(DriveRow, drive, days=31)
    busy = house.play.submit(scenes=1)
    with house.catalog.reading() as session:
        busy_drive = jobs.get(session, busy).drive_id
    house.age(DriveRow, busy_drive, days=31)
    assert house.sweep()["expired_jobs"] == 2
    assert house.groups() >= stage_keys("new") and not house.groups() & stage_keys("old")
    with house.catalog.reading() as session:
        assert drives.get(session, new_drive) and drives.get(session, busy_drive)
        with pytest.raises(NotFound):
            drives.get(session, old_drive)


def test_retention_by_size_takes_the_oldest_until_it_fits(house) -> None:
    made = [house.job(name, size=1000) for name in ("one", "two", "three")]
    for days, job in zip((3, 2, 1), made, strict=True):
        house.age(JobRow, job, days=days)
    with house.catalog.transaction() as tx:
        retention.put(tx, max_age_days=None, max_bytes=4500)
    house.sweep()
    kept = {name for name in ("one", "two", "three") if stage_keys(name) <= house.groups()}
    assert kept == {"two", "three"}, "6 kB of outputs and three drives of 9 bytes: one job is enough"
    with house.catalog.transaction() as tx:
        retention.put(tx, max_age_days=None, max_bytes=None)
    assert house.sweep()["expired_jobs"] == 0


def test_labels_of_a_deleted_project_go(house) -> None:
    job = house.job()
    with house.catalog.transaction() as tx:
        tx.session.get_one(ProjectRow, PROJECT).deleted_at = tx.now
    assert house.sweep()["expired_jobs"] == 1
    assert house.groups() == set(), job


def test_one_sweeps_at_a_time(house) -> None:
    house.delete(house.job())
    with house.catalog.alone("sweep") as mine:
        assert mine
        assert house.sweep() == {}
    assert house.sweep()["outputs"] == 2


def test_outputs_of_before_they_were_counted_are_not_taken_for_orphans(empty_url: str, tmp_path: Path) -> None:
    catalog = Catalog(empty_url).scoped(PROJECT)
    upgrade(empty_url, "0003")
    with catalog.transaction() as tx:
        for statement in _OLD_ROWS:
            tx.session.execute(text(statement))
    upgrade(empty_url)
    store = DirectoryStore(tmp_path / "store", "")
    for key in ("stages/refine-old/scene.json", "stages/refine-old/refined/x.bin"):
        store.put_bytes(key, b"x")
        os.utime(store.path_of(key), (0, 0))
    sweeper = workflow.Sweeper(catalog, store, Settings())
    sweeper.run_once()
    sweeper.run_once()
    assert len(list(store.list())) == 2
    with catalog.transaction() as tx:
        jobs.delete(tx, "job_1")
    workflow.Sweeper(catalog, store, Settings()).run_once()
    assert list(store.list()) == []
    catalog.dispose()


_DATE = "'2026-01-01 00:00:00+00:00'"
_OLD_ROWS = (
    "INSERT INTO drives (id, project_id, name, filename, size, state, created_at) "
    f"VALUES ('drv_1', 'prj_default', 'd', 'd.zip', 9, 'ready', {_DATE})",
    "INSERT INTO models (id, project_id, name, filename, size, state, created_at) "
    f"VALUES ('mdl_1', 'prj_default', 'm', 'm.zip', 9, 'ready', {_DATE})",
    "INSERT INTO jobs (id, project_id, drive_id, model_id, settings, state, cancel_requested, created_at, finished_at) "
    f"VALUES ('job_1', 'prj_default', 'drv_1', 'mdl_1', '{{}}', 'succeeded', false, {_DATE}, {_DATE})",
    "INSERT INTO stages (id, job_id, name, queue, state, attempt, progress_done, progress_total, fraction, cached, "
    "output_key, finished_at) VALUES ('stg_1', 'job_1', 'refine', 'refine', 'done', 1, 0, 0, 1, false, "
    f"'stages/refine-old/scene.json', {_DATE})",
)


def test_what_is_over_for_a_quarter_of_a_year_is_forgotten_and_what_is_not_over_is_kept(house, monkeypatch) -> None:
    monkeypatch.setattr(sweep, "PRUNE_BATCH", 1)
    made: dict[str, list[str]] = {"old": [], "new": []}
    with house.catalog.transaction() as tx:
        rule = rules.add(tx, name="r", bucket="b", prefix="", suffix=None, settings={})
        for name, since in (("old", timedelta(days=91)), ("new", timedelta(days=89))):
            for state in (UploadState.COMPLETE, UploadState.ABORTED, UploadState.OPEN):
                file = {"kind": "drive", "filename": "f", "size": 1, "parts": 1, "seconds": 10**8}
                row = uploads.add(tx, object_key=f"uploads/{name}-{state}", s3_upload_id="", **file)
                row.state, row.created_at = state, tx.now - since
                made[name].append(row.id)
            for settled in (tx.now - since, None):
                (id,) = rules.note(tx, [(rule, f"{name}{settled}", "key", "s3://b/key")])
                tx.session.get_one(ArrivalRow, id).settled_at = settled
                made[name].append(id)
    sweeper = workflow.Sweeper(house.catalog, house.store, Settings())
    rounds = [sweeper.run_once()["pruned"] for _ in range(4)]
    assert (rounds, sum(rounds)) == ([2, 1, 0, 0], 3)
    with house.catalog.reading() as session:
        left = {*session.scalars(select(UploadRow.id)), *session.scalars(select(ArrivalRow.id))}
    complete, aborted, still_open, settled, waiting = made["old"]
    assert left == {*made["new"], still_open, waiting}
    assert not {complete, aborted, settled} & left


def annotations(tx) -> None:
    tx.session.add(AnnotationsRow(id="ann_1", name="a", filename="a.zip", size=1, created_at=tx.now))
    tx.session.flush()


def test_a_bundle_beside_a_training_s_log_is_its_model_s(house) -> None:
    """Where the same training under another name was made anew, or its log is of long ago: with a log and without."""
    kept = {}
    with house.catalog.transaction() as tx:
        annotations(tx)
    for name, log in (("cached", None), ("logged", "trainings/trn_logged/log.txt")):
        model, key = house.play.model(), f"trainings/trn_{name}/bundle.zip"
        kept[model] = key
        for written in filter(None, (key, log)):
            house.store.put_bytes(written, b"x")
        values = {"id": f"trn_{name}", "name": name, "annotations_id": "ann_1", "settings": {}, "log_key": log}
        with house.catalog.transaction() as tx:
            bundles.lock(tx.session, model).object_key = key
            times = {"created_at": tx.now, "finished_at": tx.now - timedelta(days=91)}
            tx.session.add(TrainingRow(state=JobState.SUCCEEDED, model_id=model, **values, **times))
    sweeper = workflow.Sweeper(house.catalog, house.store, Settings(orphan_seconds=-1, orphans_every_seconds=0))
    for _ in range(2):
        sweeper.run_once()
    assert {*kept.values()} <= {info.key for info in house.store.list()}
    with house.catalog.transaction() as tx:
        for model in kept:
            bundles.delete(tx, model)
    for _ in range(2):
        sweeper.run_once()
    assert list(house.store.list()) == []


def test_the_log_of_a_training_of_long_ago_goes(house) -> None:
    trainings_ = {}
    with house.catalog.transaction() as tx:
        annotations(tx)
        for name, state, since in (
            ("old", JobState.SUCCEEDED, 91),
            ("new", JobState.SUCCEEDED, 89),
            ("running", JobState.RUNNING, None),
        ):
            id, log = f"trn_{name}", f"trainings/trn_{name}/log.txt"
            values = {"id": id, "name": name, "annotations_id": "ann_1", "settings": {}, "state": state, "log_key": log}
            ended = None if since is None else tx.now - timedelta(days=since)
            tx.session.add(TrainingRow(created_at=tx.now, finished_at=ended, **values))
            house.store.put_bytes(log, b"epoch 1")
            trainings_[name] = log
    sweeper = workflow.Sweeper(house.catalog, house.store, Settings(orphan_seconds=-1, orphans_every_seconds=0))
    sweeper.run_once()
    sweeper.run_once()
    assert {info.key for info in house.store.list()} == {trainings_["new"], trainings_["running"]}
