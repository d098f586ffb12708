"""A training's life in the catalog, on SQLite and PostgreSQL."""

import threading
from collections.abc import Callable

import pytest
from alembic import command
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from l3ps.errors import Cancelled, Problem
from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, JobState, StageRow, StageState, annotation_sets, bundles, stages, trainings
from l3ps_platform.catalog.migrate import _config, upgrade
from l3ps_platform.catalog.session import make_engine
from l3ps_platform.errors import Conflict, LeaseLost, NotFound
from l3ps_platform.ids import new_id

RETRY = workflow.Retry(max_attempts=3, seconds=5.0)
ERROR = {"message": "it broke", "problems": []}
SETTINGS = {"backbone": "scratch", "seed": 0}
BUNDLE = {"object_key": "k/bundle.zip", "size": 9, "sha256": "b" * 64, "info": {"classes": ["car"]}, "report": {"k": 3}}


@pytest.fixture
def images(catalog: Catalog) -> str:
    """Annotations in the catalog."""
    with catalog.transaction() as tx:
        return annotation_sets.add(tx, name="a", filename="a.zip", size=9, object_key="uploads/u/a.zip").id


@pytest.fixture
def start(catalog: Catalog, images: str) -> Callable[..., str]:
    """Starts a training; its id."""

    def submit(name: str = "m", annotations_id: str = images, settings: dict = SETTINGS, **given) -> str:
        with catalog.transaction() as tx:
            return workflow.submit_training(tx, name=name, annotations_id=annotations_id, settings=settings, **given).id

    return submit


@pytest.fixture
def see(catalog: Catalog) -> Callable:
    """The training's row as it is now."""

    def look(id: str):
        with catalog.reading() as session:
            return trainings.get(session, id)

    return look


def done(tx, claim) -> None:
    workflow.training_done(tx, claim, workflow.Cost(2.0), **BUNDLE)


def test_a_training_becomes_a_ready_model(play, sent, start, see) -> None:
    id = start()
    (message,) = sent
    assert (message.name, message.queue) == ("train", "train")
    play.run(done)
    row = see(id)
    assert (row.state, row.report) == (JobState.SUCCEEDED, {"k": 3})
    assert row.created_at <= row.started_at <= row.finished_at
    with play.catalog.reading() as session:
        model = bundles.by_name(session, "m")
    assert (model.id, model.state, model.object_key, model.sha256) == (row.model_id, "ready", "k/bundle.zip", "b" * 64)
    assert model.info == {"classes": ["car"], "training": id, "report": {"k": 3}}
    drive = play.drive(scenes=1)
    with play.catalog.transaction() as tx:
        assert workflow.submit_job(tx, drive_id=drive, model="m").state is JobState.QUEUED


def test_the_same_request_again_is_the_same_training(play, sent, start) -> None:
    id = start()
    assert start() == id
    play.run(done)
    assert start() == id
    assert not sent


def test_a_name_belongs_to_one_training_or_model(play, sent, start, catalog: Catalog) -> None:
    id = start()
    with pytest.raises(Conflict, match=f"training {id} is to become"):
        start(settings={"backbone": "scratch", "seed": 1})
    play.run(done)
    with pytest.raises(Conflict, match="there is a model named"):
        start(settings={"backbone": "scratch", "seed": 1})
    with catalog.transaction() as tx:
        workflow.accept_model(tx, name="uploaded", filename="m.zip", size=1, object_key="k")
    with pytest.raises(Conflict, match="there is a model named"):
        start("uploaded")


def test_a_name_that_was_taken_meanwhile_fails_the_training_and_keeps_the_model(play, sent, start, see) -> None:
    id = start()
    message = sent.pop()
    with play.catalog.transaction() as tx:
        uploaded = workflow.accept_model(tx, name="m", filename="m.zip", size=1, object_key="k").id
    play.run(done, message)
    row = see(id)
    assert (row.state, row.error["problems"][0]["code"]) == (JobState.FAILED, "name-taken")
    assert "another name" in row.error["message"]
    with play.catalog.reading() as session:
        assert bundles.by_name(session, "m").id == uploaded
        assert stages.of_training(session, id).seconds == 2.0


def test_a_failed_training_says_why_and_may_be_asked_for_again(play, sent, start, see) -> None:
    id = start()
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR))
    assert (see(id).state, see(id).error) == (JobState.FAILED, ERROR)
    assert start() != id


def test_what_may_pass_is_tried_again(play, sent, start, see) -> None:
    id = start()
    play.run(lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=RETRY))
    with play.catalog.reading() as session:
        stage = stages.of_training(session, id)
    assert (see(id).state, stage.state, stage.attempt) == (JobState.RUNNING, StageState.WAITING, 2)


def test_a_dead_worker_s_training_goes_on(play, sent, start, see, tidy) -> None:
    id = start()
    play.take(lease=-1)
    assert tidy(retry_seconds=0).expired == 1
    assert [(m.name, m.attempt) for m in sent] == [("train", 2)]
    play.run(done)
    assert see(id).state is JobState.SUCCEEDED


def test_notes_are_the_owner_s_alone(play, sent, start, see, tidy) -> None:
    id = start()
    dead = play.take(owner="dead", lease=-1)
    tidy(retry_seconds=0)
    claim = play.take(owner="alive")
    with play.catalog.transaction() as tx:
        workflow.note_training(tx, claim, figures={"loss": 0.5}, log_key="l")
        workflow.note_training(tx, claim, figures={"loss": 0.4})
    with pytest.raises(LeaseLost), play.catalog.transaction() as tx:
        workflow.note_training(tx, dead, figures={"loss": 9})
    assert (see(id).figures, see(id).log_key) == ({"loss": 0.4}, "l")


class TestCancel:
    def test_before_it_began(self, play, sent, start, see) -> None:
        id = start()
        with play.catalog.transaction() as tx:
            workflow.cancel_training(tx, id)
        assert see(id).state is JobState.CANCELLED
        assert play.take() is None
        assert start() != id, "a cancelled one is no answer to a new request"

    @pytest.mark.parametrize(
        "end",
        [done, workflow.cancelled, workflow.release, lambda tx, claim: workflow.fail(tx, claim, ERROR, retry=RETRY)],
        ids=["done", "cancelled", "released", "failed"],
    )
    def test_a_running_one_learns_of_it_and_registers_nothing_however_it_ends(
        self, play, sent, start, see, end
    ) -> None:
        id = start()
        claim = play.take()
        with play.catalog.transaction() as tx:
            workflow.cancel_training(tx, id)
        assert see(id).state is JobState.RUNNING
        with pytest.raises(Cancelled), play.catalog.transaction() as tx:
            workflow.report(tx, claim, "train", 1, 6, fraction=0.2)
        with play.catalog.transaction() as tx:
            end(tx, claim)
        assert see(id).state is JobState.CANCELLED
        with pytest.raises(NotFound), play.catalog.reading() as session:
            bundles.by_name(session, "m")
        assert not sent

    def test_a_finished_one_stays_as_it_is(self, play, sent, start, see) -> None:
        id = start()
        play.run(done)
        with play.catalog.transaction() as tx:
            workflow.cancel_training(tx, id)
        assert see(id).state is JobState.SUCCEEDED


class TestAnnotations:
    def test_kept_while_a_training_needs_them(self, play, sent, start, images, tidy) -> None:
        tidy.store.put_bytes("uploads/u/a.zip", b"archive")
        with play.catalog.transaction() as tx:
            other = annotation_sets.add(tx, name="b", filename="b.zip", size=9, object_key="uploads/u/b.zip").id
        id = start(validation_id=other)
        for each in (images, other):
            with pytest.raises(Conflict, match=id), play.catalog.transaction() as tx:
                annotation_sets.delete(tx, each)
        play.run(done)
        with play.catalog.transaction() as tx:
            annotation_sets.delete(tx, images)
        assert tidy.sweep()["archives"] == 1
        assert not tidy.store.exists("uploads/u/a.zip")
        with play.catalog.reading() as session:
            assert [row.id for row in annotation_sets.page(session)] == [other]
        with pytest.raises(NotFound):
            start("again")

    def test_unknown_ones(self, start) -> None:
        with pytest.raises(NotFound, match="no annotations 'ann_none'"):
            start(annotations_id="ann_none")


def test_the_migration_keeps_every_row_and_every_rule(empty_url: str) -> None:
    """From the first schema, with a job's stages and their steps: SQLite makes the table of stages anew."""
    engine = make_engine(empty_url)
    with engine.begin() as connection:
        command.upgrade(_config(connection), "0001")
        connection.execute(
            text(
                "INSERT INTO drives (id, name, filename, size, state, created_at) "
                "VALUES ('drv_1', 'd', 'd.zip', 1, 'ready', '2026-01-01 00:00:00')"
            )
        )
        connection.execute(
            text(
                "INSERT INTO stages (id, drive_id, name, queue, state, attempt, progress_done, progress_total, "
                "fraction, cached) VALUES ('stg_1', 'drv_1', 'ingest', 'refine', 'done', 1, 0, 0, 1, false)"
            )
        )
        connection.execute(text("INSERT INTO steps (stage_id, name, seconds, peak_mb) VALUES ('stg_1', 's', 1, 2)"))
    engine.dispose()
    upgrade(empty_url)
    catalog = Catalog(empty_url)
    with catalog.reading() as session:
        assert stages.get(session, "stg_1").drive_id == "drv_1"
        assert [step.name for step in stages.steps(session, ["stg_1"])["stg_1"]] == ["s"]
    for wrong in ("name = 'dance'", "queue = 'dance'", "state = 'dance'", "training_id = 'trn_none'"):
        with pytest.raises(IntegrityError), catalog.transaction() as tx:
            tx.session.execute(text(f"UPDATE stages SET {wrong} WHERE id = 'stg_1'"))
    with catalog.transaction() as tx:
        tx.session.add(StageRow(id=new_id("stg"), name="train", queue="train", state="waiting", attempt=1))
        tx.session.execute(text("DELETE FROM stages WHERE id = 'stg_1'"))
        assert tx.session.scalar(text("SELECT count(*) FROM steps")) == 0
    catalog.dispose()


@pytest.mark.parametrize("migrated_url", ["postgresql"], indirect=True)  # SQLite has one lock
def test_starting_and_retrying_do_not_wait_for_each_other_for_ever(catalog: Catalog, play, start, images, see) -> None:
    """Both hold the annotations and the model that has the name, in the same order."""
    id, rejected = start(), play.model(problems=[Problem("no-graph", "m.zip", "it holds none", "Export it again.")])
    with catalog.transaction() as tx:
        bundles.lock(tx.session, rejected).name = "m"
        workflow.cancel_training(tx, id)
    errors = []

    def retry() -> None:
        try:
            with catalog.transaction() as tx:
                workflow.retry_training(tx, id)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=retry)
    with catalog.transaction() as tx:
        annotation_sets.lock(tx.session, images)
        thread.start()
        waiting = text("SELECT 1 FROM pg_locks WHERE NOT granted")
        while tx.session.execute(waiting).first() is None:
            pass
        assert bundles.named(tx.session, "m").id == rejected
    thread.join()
    assert not errors
    assert see(id).state is JobState.QUEUED


def test_a_training_whose_annotations_are_gone_cannot_be_run_again(catalog: Catalog, start, images) -> None:
    id = start()
    with catalog.transaction() as tx:
        workflow.cancel_training(tx, id)
        annotation_sets.delete(tx, images)
    with pytest.raises(Conflict, match="upload it again"), catalog.transaction() as tx:
        workflow.retry_training(tx, id)
