"""The stage that trains: what becomes of the trainer's events, and of the trainer, however it ends."""

import io
import json
import os
import re
import shutil
import signal
import zipfile
from pathlib import Path

import pytest
import structlog
from structlog.testing import capture_logs

from l3ps_platform import workflow
from l3ps_platform.catalog import JobState, StageState, annotation_sets, bundles, stages, trainings
from l3ps_worker import runner


@pytest.fixture(autouse=True)
def stand_in(tmp_path: Path, fast_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What child processes find under the trainer's name."""
    package = tmp_path / "path" / "l3ps_trainer"
    shutil.copytree(_unzipped(fast_model, tmp_path / "bundle"), package / "bundle")
    (package / "__init__.py").touch()
    shutil.copy(Path(__file__).with_name("stand_in_trainer.py"), package / "__main__.py")
    monkeypatch.setenv("PYTHONPATH", str(package.parent))


def _unzipped(archive: Path, folder: Path) -> Path:
    with zipfile.ZipFile(archive) as bundle:
        bundle.extractall(folder)
    return folder


class Desk:
    """Annotations and trainings of a bench."""

    def __init__(self, bench) -> None:
        self.bench = bench

    def images(self, **members: str) -> str:
        """An archive of annotations in the store and the catalog."""
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w") as archive:
            for name in ("images/b.png", "images/a.png", "semantic/a.png"):
                archive.writestr(f"thirty/{name}", members.get("content", "x"))
        key = f"uploads/{len(list(self.bench.store.list('uploads/')))}/thirty.zip"
        self.bench.store.put_bytes(key, members.get("archive", data.getvalue()))
        with self.bench.catalog.transaction() as tx:
            return annotation_sets.add(tx, name="thirty", filename="thirty.zip", size=9, object_key=key).id

    def start(self, mood: str = "well", name: str = "m", *, images: str | None = None, **settings) -> str:
        asked = {"backbone": "scratch", "recipe": mood, "seed": 3, **settings}
        images = images or self.images()
        with self.bench.catalog.transaction() as tx:
            return workflow.submit_training(tx, name=name, annotations_id=images, settings=asked).id

    def row(self, id: str):
        with self.bench.catalog.reading() as session:
            return trainings.get(session, id)

    def stage(self, id: str):
        with self.bench.catalog.reading() as session:
            return stages.of_training(session, id)

    def log(self, id: str) -> str:
        return self.bench.store.get_bytes(self.row(id).log_key).decode()

    def cancel(self, id: str) -> None:
        with self.bench.catalog.transaction() as tx:
            workflow.cancel_training(tx, id)

    def again(self, id: str) -> None:
        """What the reconciler does with a stage that waits for its next attempt."""
        with self.bench.catalog.transaction() as tx:
            workflow.planning.enqueue(tx, stages.of_training(tx.session, id))


@pytest.fixture
def desk(direct) -> Desk:
    return Desk(direct)


def test_a_training_becomes_a_model_with_its_report(direct, desk: Desk) -> None:
    id = desk.start(size=[64, 128], int8=True, classes={"classes": [{"id": 0, "name": "sky"}]})
    assert direct.run() == ["done"]
    row, stage = desk.row(id), desk.stage(id)
    assert (row.state, row.figures) == (JobState.SUCCEEDED, {"loss": pytest.approx(1 / 3), "miou": 30.0})
    assert row.report["images"] == ["a.png", "b.png"], "a folder around the images is entered"
    expected = {"out": "out", "name": "m", "backbone": "scratch", "recipe": "well", "seed": "3", "size": "64x128"}
    assert row.report["options"] == expected | {"threads": "1", "classes": "classes.json"}
    assert "2 images" in desk.log(id)
    assert {"train", "validate"} == {step.name for step in _steps(direct, stage)}
    assert stage.cpu_seconds > 0 and stage.fraction == 1.0
    model = direct.model(row.model_id)
    assert (model.name, model.state, model.info["report"]) == ("m", "ready", row.report)
    assert model.info["input"] == [32, 64] and model.info["training"] == id
    kept = {info.key.rpartition("/")[2] for info in direct.store.list()}
    assert kept == {"thirty.zip", "bundle.zip", "log.txt"}, "no checkpoint is left"
    assert list((direct.settings.scratch / "work").iterdir()) == []


def _steps(bench, stage) -> list:
    with bench.catalog.reading() as session:
        return stages.steps(session, [stage.id])[stage.id]


def test_what_the_trainer_says_stands_in_the_worker_s_log_under_the_training_s_ids(direct, desk: Desk) -> None:
    with capture_logs([structlog.contextvars.merge_contextvars]) as lines:
        id = desk.start()
        direct.run()
    said = [line for line in lines if line["event"] == "trainer"]
    assert [line["line"] for line in said] == desk.log(id).splitlines()
    assert {(line["training"], line["kind"], line["attempt"]) for line in said} == {(id, "train", 1)}


def test_a_trained_model_labels_a_drive(direct, desk: Desk, short_zip: Path) -> None:
    desk.start()
    drive = direct.upload_drive(short_zip)
    assert set(direct.run()) == {"done"}
    job = direct.submit(drive, preset="fast")
    assert set(direct.run()) == {"done"}
    assert direct.job(job).state is JobState.SUCCEEDED


def test_the_same_training_under_another_name_comes_from_the_store(direct, desk: Desk) -> None:
    images = desk.images()
    first, second, other = (
        desk.start(name=name, images=images, seed=seed) for name, seed in (("one", 0), ("two", 0), ("three", 1))
    )
    assert direct.run() == ["done"] * 3
    assert [desk.stage(id).cached for id in (first, second, other)] == [False, True, False]
    with direct.catalog.reading() as session:
        one, two = (bundles.get(session, desk.row(id).model_id) for id in (first, second))
    assert (one.info["name"], two.info["name"]) == ("one", "two")
    with zipfile.ZipFile(io.BytesIO(direct.store.get_bytes(two.object_key))) as bundle:
        assert json.loads(bundle.read("model.json"))["name"] == "two"
    assert desk.row(second).report["options"]["name"] == "one", "the report is of the training that was"


def test_the_trainer_s_problems_are_the_training_s_under_the_user_s_names(direct, desk: Desk) -> None:
    id = desk.start("refuses")
    assert direct.run() == ["failed"]
    row = desk.row(id)
    assert row.state is JobState.FAILED
    found = [(problem["where"], problem["code"]) for problem in row.error["problems"]]
    assert found == [("thirty.zip/images/a.png", "no-label"), ("thirty.zip/semantic", "empty"), ("size", "bad-size")]
    assert not [info.key for info in direct.store.list("stages/")]


@pytest.mark.parametrize(("archive", "code"), [(b"no zip", "not-an-archive"), (b"PK\x03\x04", "truncated-archive")])
def test_an_archive_that_is_none_fails_with_its_problem(direct, desk: Desk, archive: bytes, code: str) -> None:
    id = desk.start(images=desk.images(archive=archive))
    assert direct.run() == ["failed"]
    (problem,) = desk.row(id).error["problems"]
    assert (problem["where"], problem["code"]) == ("thirty.zip", code)
    assert "log" not in problem["remedy"]


def test_an_unknown_backbone_says_which_there_are(direct, desk: Desk) -> None:
    (direct.settings.backbones / "pair").mkdir(parents=True)
    for name in ("pair/one.onnx", "one.onnx", "dinov2_vits14_reg4_pretrain.pth", "dinov2-b.pth", "notes.pth", "a.txt"):
        (direct.settings.backbones / name).write_bytes(b"x")
    id = desk.start(backbone="dinov2-l")
    assert direct.run() == ["failed"]
    (problem,) = desk.row(id).error["problems"]
    assert problem["code"] == "unknown-backbone" and "'dinov2-l'" in problem["what"]
    assert "dinov2-b, dinov2-s-reg, one, pair, scratch." in problem["remedy"]
    assert str(direct.settings.backbones) not in json.dumps(desk.row(id).error)


def test_backbones_by_name_become_paths_for_the_trainer_alone(direct, desk: Desk) -> None:
    folder = direct.settings.backbones
    folder.mkdir()
    (folder / "net.onnx").write_bytes(b"x")
    (folder / "dinov2_vits14_pretrain.pth").write_bytes(b"x")
    graph, weights = desk.start(backbone="net", name="a"), desk.start(backbone="dinov2-s", name="b")
    assert direct.run() == ["done"] * 2
    assert desk.row(graph).report["options"]["backbone"] == f"onnx:{folder / 'net.onnx'}"
    options = desk.row(weights).report["options"]
    assert (options["backbone"], options["weights"]) == ("dinov2-s", f"{folder / 'dinov2_vits14_pretrain.pth'}")
    (folder / "net.onnx").write_bytes(b"y")
    changed = desk.start(backbone="net", name="c")
    direct.run()
    assert not desk.stage(changed).cached, "other bytes under the same name are another backbone"


def test_a_killed_trainer_s_next_attempt_goes_on_from_its_checkpoint(direct, desk: Desk) -> None:
    id = desk.start("dies")
    for attempt, begun in ((1, 0), (2, 1), (3, 2)):
        last = attempt == 3
        assert direct.step() == ("done" if last else "failed")
        assert desk.log(id).splitlines()[-1] == f"from step {begun}"
        if not last:
            stage = desk.stage(id)
            assert (stage.state, stage.attempt) == (StageState.WAITING, attempt + 1)
            assert "was killed" in stage.error["message"]
            desk.again(id)
    assert desk.row(id).state is JobState.SUCCEEDED
    assert [line for line in desk.log(id).splitlines() if "step" in line] == [f"from step {n}" for n in range(3)]


def test_a_crash_is_told_with_the_last_word_of_the_log(direct, desk: Desk) -> None:
    id = desk.start("crashes")
    assert direct.step() == "failed"
    message = desk.stage(id).error["message"]
    assert "exit status 1" in message and message.endswith("Traceback: something broke")


def during(monkeypatch: pytest.MonkeyPatch, act) -> None:
    """Do something once the trainer has told its first figures."""
    work, steps = runner.WORK[runner.StageName.TRAIN]

    def disturbed(context, claim, progress):
        acted = []

        def report(step: str, done: int, total: int) -> None:
            if step == "train" and not acted:
                acted.append(act())
            progress(step, done, total)

        return work(context, claim, report)

    monkeypatch.setitem(runner.WORK, runner.StageName.TRAIN, (disturbed, steps))


def test_a_cancelled_training_ends_with_its_trainer(direct, desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    id = desk.start("stays")
    during(monkeypatch, lambda: desk.cancel(id))
    assert direct.step() == "cancelled"
    assert desk.row(id).state is JobState.CANCELLED
    assert desk.log(id).endswith("told to leave\n")
    assert not [info.key for info in direct.store.list("stages/")]


def test_a_trainer_that_does_not_listen_is_killed_with_all_it_forked(direct, desk, monkeypatch) -> None:
    id = desk.start("deaf")
    monkeypatch.setattr("l3ps_worker.trainer.LEAVE_SECONDS", 0.5)
    during(monkeypatch, lambda: desk.cancel(id))
    assert direct.step() == "cancelled"
    forked = int(re.search(r"forked (\d+)", desk.log(id))[1])
    direct.until(lambda: not alive(forked), seconds=10)


def test_a_stopping_worker_gives_the_training_back_with_its_checkpoint(direct, desk: Desk, monkeypatch) -> None:
    id = desk.start("stays")
    during(monkeypatch, direct.context.stopping.set)
    assert direct.step() == "released"
    stage = desk.stage(id)
    assert (stage.state, stage.attempt) == (StageState.QUEUED, 1)
    (checkpoint,) = direct.store.list("stages/")
    assert direct.store.get_bytes(checkpoint.key) == b"2", "the trainer was asked to write one more"


def test_a_training_that_another_worker_took_over_leaves_no_trace(direct, desk: Desk, monkeypatch) -> None:
    id = desk.start("stays")
    message = direct.sent[0]

    def steal() -> None:
        with direct.catalog.transaction() as tx:
            workflow.lease_lost(tx, message.stage_id, workflow.Retry(3, 0))

    during(monkeypatch, steal)
    assert direct.step() == "lost"
    assert desk.row(id).state is JobState.RUNNING
    assert not [info for info in direct.store.list("stages/") if direct.store.get_bytes(info.key) == b"2"]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.services
def test_a_training_survives_its_trainer_and_its_worker_and_can_be_cancelled(served, worker) -> None:
    """A real worker: its trainer is killed, then the process that watches over it, and at last a client has enough."""
    with served(checkpoint_seconds=0.1) as bench:
        desk = Desk(bench)
        process = worker(bench, "train")
        id = desk.start("stays")

        def at_work(attempt: int) -> int | None:
            """The process that watches over the trainer, once this attempt's checkpoint and log are in the store."""
            stage, stored = desk.stage(id), [bench.store.get_bytes(i.key) for i in bench.store.list("stages/")]
            if stage.attempt != attempt or stored != [str(attempt).encode()] or desk.row(id).log_key is None:
                return None
            return int(stage.lease_owner.rpartition(":")[2]) if f"from step {attempt - 1}" in desk.log(id) else None

        watcher = bench.until(lambda: at_work(1))
        (trainer,) = children_of(watcher)
        os.kill(trainer, signal.SIGKILL)
        watcher = bench.until(lambda: at_work(2))
        (trainer,) = children_of(watcher)
        os.kill(watcher, signal.SIGKILL)
        bench.until(lambda: not alive(trainer))
        bench.until(lambda: at_work(3))
        begun = [line for line in desk.log(id).splitlines() if line.startswith("from step")]
        assert begun == ["from step 0", "from step 1", "from step 2"]
        desk.cancel(id)
        bench.until(lambda: desk.row(id).state.final)
        assert desk.row(id).state is JobState.CANCELLED
        assert process.poll() is None
