"""Rows and their rules, on SQLite and PostgreSQL."""

import threading
from contextlib import ExitStack
from datetime import timedelta

import psycopg
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError, OperationalError

from l3ps.errors import DriveLogError, ModelError, Problem
from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Base,
    Catalog,
    DriveState,
    JobRow,
    JobState,
    ModelState,
    UploadState,
    bundles,
    drives,
    jobs,
    stages,
    uploads,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.catalog.session import make_engine
from l3ps_platform.errors import CatalogUnavailable, Conflict, NotFound
from l3ps_platform.settings import Settings

SPOILT = Problem("truncated-scan", "samples/x.bin", "it ends after 3 bytes", "Copy it again.", "scan", "scene-0", "x")
BROKEN = Problem("no-calibration", "calib.txt", "it is missing", "Add it.")


def test_migrations_make_the_tables_that_the_code_expects(empty_url: str) -> None:
    upgrade(empty_url)
    engine = make_engine(empty_url)
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
    engine.dispose()


def test_services_that_start_together_migrate_once(empty_url: str) -> None:
    barrier, errors = threading.Barrier(4), []

    def start() -> None:
        barrier.wait()
        try:
            upgrade(empty_url)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_messages_leave_after_the_commit_and_not_after_a_rollback(catalog: Catalog, play, sent) -> None:
    with pytest.raises(RuntimeError), catalog.transaction() as tx:
        workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
        raise RuntimeError
    assert not sent
    with catalog.reading() as session:
        assert drives.page(session) == []
    with catalog.transaction() as tx:
        workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
        assert not sent
    assert len(sent) == 1


def test_a_queue_that_is_away_does_not_undo_the_commit(catalog: Catalog) -> None:
    def away(_: object) -> None:
        raise OSError("no queue")

    lonely = Catalog(catalog.url, away).scoped(DEFAULT_PROJECT)
    with lonely.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
    lonely.dispose()
    with catalog.reading() as session:
        assert drives.get(session, drive.id).state is DriveState.UPLOADED


def test_reading_changes_nothing(catalog: Catalog, play) -> None:
    drive = play.drive()
    with catalog.reading() as session:
        drives.get(session, drive).name = "changed"
        session.flush()
    with catalog.reading() as session:
        assert drives.get(session, drive).name == "drive"


def test_dates_come_back_aware_and_in_utc(catalog: Catalog, play) -> None:
    drive = play.drive()
    with catalog.transaction() as tx:
        created = drives.get(tx.session, drive).created_at
        assert timedelta() <= tx.now - created < timedelta(minutes=5)
        assert created.utcoffset() == timedelta()


def test_rows_need_their_parents(catalog: Catalog) -> None:
    with pytest.raises(IntegrityError), catalog.transaction() as tx:
        tx.session.add(JobRow(id="job_x", drive_id="drv_none", model_id="mdl_none", settings={}, created_at=tx.now))


def test_writers_wait_for_each_other(catalog: Catalog) -> None:
    """Forty transactions that read, then write, from eight threads: SQLite's deferred ones would fail as locked."""
    errors = []

    def write(n: int) -> None:
        try:
            for k in range(5):
                with catalog.transaction() as tx:
                    drives.page(tx.session)
                    workflow.accept_drive(tx, name=f"{n}-{k}", filename="d.zip", size=1, object_key="k")
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    with catalog.reading() as session:
        assert len(drives.page(session, limit=100)) == 40


def test_pages_follow_each_other_newest_first(catalog: Catalog, play) -> None:
    made = [play.drive() for _ in range(5)]
    with catalog.reading() as session:
        first = drives.page(session, limit=2)
        second = drives.page(session, limit=9, before=first[-1].id)
    assert [row.id for row in first + second] == made[::-1]


@pytest.mark.parametrize(
    ("kind", "find"),
    [("drive", drives.get), ("model", bundles.get), ("job", jobs.get), ("upload", uploads.get), ("stage", stages.get)],
)
def test_what_is_not_there_is_named(catalog: Catalog, kind: str, find) -> None:
    with pytest.raises(NotFound, match=f"no {kind} 'x'") as caught, catalog.reading() as session:
        find(session, "x")
    assert (caught.value.kind, caught.value.id) == (kind, "x")


def test_a_database_that_is_away() -> None:
    away = Catalog("postgresql+psycopg://nobody@127.0.0.1:1/none")
    with pytest.raises(CatalogUnavailable, match="does not answer"):
        away.ping()


def test_what_is_too_large_for_the_database_is_no_outage(postgres_url: str) -> None:
    """It would be waited for in vain."""
    catalog = Catalog(Settings(database_url=postgres_url).catalog_url)
    with pytest.raises(OperationalError, match="too deep"), catalog.reading() as session:
        session.execute(text("DO $$ BEGIN RAISE EXCEPTION 'too deep' USING ERRCODE = '54001'; END $$"))
    catalog.dispose()


def test_a_silent_server_is_given_up_in_seconds(postgres_url: str) -> None:
    catalog = Catalog(Settings(database_url=postgres_url).catalog_url)
    with catalog.reading() as session:
        given = session.connection().connection.driver_connection.info.get_parameters()
    catalog.dispose()
    idle, between, count = (int(given[f"keepalives_{name}"]) for name in ("idle", "interval", "count"))
    assert idle + between * count <= 30 and int(given["tcp_user_timeout"]) <= 30_000


def test_a_catalog_whose_connections_are_all_in_use_is_busy_and_not_broken(catalog: Catalog, monkeypatch) -> None:
    monkeypatch.setattr(catalog.engine.pool, "_timeout", 0.0)
    with ExitStack() as held:
        for _ in range(catalog.engine.pool.size()):
            held.enter_context(catalog.reading())
        with pytest.raises(CatalogUnavailable, match="no connection became free"):
            catalog.ping()


HOSTILE = "a\0b\ud800c"


def test_what_one_database_would_refuse_both_keep_cleaned(catalog: Catalog, play) -> None:
    """A worker that cannot record what it found in a stranger's file cannot end its stage."""
    info = {"classes": [HOSTILE], HOSTILE: {"nan": float("nan"), "far": -float("inf")}, "good": ["ä\U0001f600", 0.5]}
    drive = play.drive(info={"scenes": []} | info, format=HOSTILE)
    with catalog.reading() as session:
        row = drives.get(session, drive)
        clean = "a\ufffdb\ufffdc"
        assert row.format == clean
        assert row.info == {
            "scenes": [],
            "classes": [clean],
            clean: {"nan": None, "far": None},
            "good": ["ä\U0001f600", 0.5],
        }
        with pytest.raises(NotFound):
            drives.get(session, HOSTILE)


def test_a_database_that_goes_while_a_session_is_open(postgres_url: str) -> None:
    catalog = Catalog(Settings(database_url=postgres_url).catalog_url)
    with pytest.raises(CatalogUnavailable, match="does not answer"), catalog.reading() as session:
        backend = session.scalar(text("SELECT pg_backend_pid()"))
        with psycopg.connect(postgres_url, autocommit=True) as other:
            other.execute("SELECT pg_terminate_backend(%s)", [backend])
    catalog.dispose()


class TestDrives:
    def test_a_drive_with_unfinished_jobs_is_kept(self, catalog: Catalog, play, sent) -> None:
        job = play.submit(scenes=1)
        drive = play.job(job).drive_id
        with pytest.raises(Conflict, match=job), catalog.transaction() as tx:
            drives.delete(tx, drive)
        play.finish_all()
        with catalog.transaction() as tx:
            drives.delete(tx, drive)
        with catalog.reading() as session:
            assert drives.page(session) == []
            assert jobs.get(session, job).state is JobState.SUCCEEDED
        with pytest.raises(NotFound), catalog.transaction() as tx:
            drives.delete(tx, drive)
        with pytest.raises(NotFound), catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=play.job(job).model_id)

    def test_a_drive_under_inspection_is_kept(self, catalog: Catalog) -> None:
        with catalog.transaction() as tx:
            drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
        with pytest.raises(Conflict, match="being checked"), catalog.transaction() as tx:
            drives.delete(tx, drive.id)

    def test_found_by_checksum(self, catalog: Catalog, play) -> None:
        drive = play.drive(sha256="b" * 64)
        play.drive(sha256="c" * 64)
        with catalog.reading() as session:
            assert [row.id for row in drives.page(session, sha256="b" * 64)] == [drive]


class TestModels:
    def test_a_name_is_taken_once(self, catalog: Catalog, play) -> None:
        given = {"filename": "m.zip", "size": 1, "object_key": "k"}
        with catalog.transaction() as tx:
            workflow.accept_model(tx, name="m", **given)
        with pytest.raises(Conflict, match="choose another name"), catalog.transaction() as tx:
            workflow.accept_model(tx, name="m", **given)

    def test_a_name_is_taken_once_by_uploads_at_the_same_moment(self, catalog: Catalog) -> None:
        barrier, outcomes = threading.Barrier(4), []

        def upload() -> None:
            barrier.wait()
            try:
                with catalog.transaction() as tx:
                    workflow.accept_model(tx, name="m", filename="m.zip", size=1, object_key="k")
                outcomes.append("taken")
            except Conflict:
                outcomes.append("conflict")

        threads = [threading.Thread(target=upload) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(outcomes) == ["conflict", "conflict", "conflict", "taken"]

    def test_a_rejected_model_gives_up_its_name(self, catalog: Catalog, play) -> None:
        rejected = play.model(problems=[BROKEN])
        with catalog.reading() as session:
            row = bundles.get(session, rejected)
        assert (row.state, row.problem) == (ModelState.REJECTED, {"problems": [BROKEN.as_dict()], "count": 1})
        with catalog.transaction() as tx:
            again = workflow.accept_model(tx, name=row.name, filename="m.zip", size=1, object_key="k")
        with catalog.reading() as session:
            assert bundles.by_name(session, row.name).id == again.id


class TestSubmit:
    def test_a_rejected_drive_says_why(self, catalog: Catalog, play) -> None:
        drive, model = play.drive(usable=False, problems=[BROKEN]), play.model()
        with pytest.raises(DriveLogError) as caught, catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=model)
        assert caught.value.problems == (BROKEN,)
        with catalog.reading() as session:
            assert jobs.page(session) == []

    def test_a_rejected_model_says_why(self, catalog: Catalog, play) -> None:
        drive, model = play.drive(), play.model(problems=[BROKEN])
        with pytest.raises(ModelError), catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=model)

    def test_a_way_to_look_at_images_that_the_model_has_no_graph_for_is_refused(self, catalog: Catalog, play) -> None:
        drive, plain, rich = play.drive(), play.model(), play.model(info={"passes": ["balanced"]})
        with pytest.raises(ModelError, match="no graph for the preset 'balanced'"), catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=plain, segment="balanced")
        with catalog.transaction() as tx:
            job = workflow.submit_job(tx, drive_id=drive, model=rich, segment="balanced")
            assert job.settings["segment"] == "balanced"

    def test_bad_scans_are_skipped_only_when_asked(self, catalog: Catalog, play, sent) -> None:
        drive, model = play.drive(problems=[SPOILT]), play.model()
        with pytest.raises(DriveLogError, match="3 bytes"), catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=model)
        with catalog.transaction() as tx:
            job = workflow.submit_job(tx, drive_id=drive, model=model, skip_bad_scans=True)
        play.finish_all()
        assert play.job(job.id).state is JobState.SUCCEEDED

    def test_warnings_do_not_stop_a_job(self, catalog: Catalog, play) -> None:
        warning = Problem("odd-name", "x", "it is odd", "Nothing to do.", "warning")
        drive, model = play.drive(problems=[warning]), play.model()
        with catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=model)

    def test_a_job_may_be_submitted_before_the_upload_is_checked(self, catalog: Catalog, play, sent) -> None:
        """It starts when both drive and model are ready."""
        with catalog.transaction() as tx:
            drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
            model = workflow.accept_model(tx, name="m", filename="m.zip", size=1, object_key="k")
        with catalog.transaction() as tx:
            job = workflow.submit_job(tx, drive_id=drive.id, model="m")
        info = {"scenes": [{"name": "s", "scans": 1, "points": 5}], "truth_space": "semantickitti"}
        play.run(
            lambda tx, claim: workflow.drive_checked(
                tx, claim, workflow.Cost(1.0), usable=True, problems=[], info=info, sha256="x", format="semantickitti"
            )
        )
        assert play.states(job.id) == []
        play.run(lambda tx, claim: workflow.model_checked(tx, claim, workflow.Cost(1.0), problems=[], sha256="y"))
        assert model.id == play.job(job.id).model_id
        assert play.finish_all() == ["segment", "refine", "publish"]
        assert play.job(job.id).settings["protocol"] == "semantickitti"

    def test_a_job_fails_with_the_problems_of_the_drive_it_waited_for(self, catalog: Catalog, play, sent) -> None:
        with catalog.transaction() as tx:
            drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=1, object_key="k")
        message = sent.pop()
        model = play.model()
        with catalog.transaction() as tx:
            job = workflow.submit_job(tx, drive_id=drive.id, model=model)
        play.run(
            lambda tx, claim: workflow.drive_checked(
                tx, claim, workflow.Cost(1.0), usable=False, problems=[BROKEN], sha256="x"
            ),
            message,
        )
        row = play.job(job.id)
        assert row.state is JobState.FAILED
        assert row.error["problems"] == [BROKEN.as_dict()]

    def test_progress_of_many_jobs(self, catalog: Catalog, play, sent) -> None:
        """Two of five stages done and a third half done."""
        job, idle = play.submit(scenes=2), play.submit(scenes=1)
        for _ in range(2):
            play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0)))
        refine = next(message for message in sent if message.name == "refine")
        claim = play.take(refine)
        with catalog.transaction() as tx:
            workflow.report(tx, claim, "vote", 1, 1, fraction=0.5)
        with catalog.reading() as session:
            assert stages.progress(session, [job, idle]) == {job: (2.5, 5), idle: (0.0, 3)}


class TestUploads:
    def test_closed_once(self, catalog: Catalog) -> None:
        with catalog.transaction() as tx:
            row = uploads.add(
                tx, kind="drive", filename="d", size=1, parts=1, object_key="k", s3_upload_id="u", seconds=60
            )
        with catalog.transaction() as tx:
            uploads.close(tx, row.id, UploadState.COMPLETE, "drv_x")
        with pytest.raises(Conflict, match="is complete"), catalog.transaction() as tx:
            uploads.close(tx, row.id, UploadState.ABORTED)
        with catalog.reading() as session:
            assert uploads.get(session, row.id).result_id == "drv_x"
