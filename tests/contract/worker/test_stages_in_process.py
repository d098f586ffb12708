"""What the stages do, run in this process on SQLite and a directory."""

import errno
import hashlib
import io
import json
import shutil
import tarfile
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.evaluate import evaluate_drive
from l3ps.labels import open_labels, read_poses
from l3ps.segment import check
from l3ps_platform import workflow
from l3ps_platform.catalog import DriveState, JobState, ModelState, StageState, jobs, outputs, stages
from l3ps_platform.errors import CatalogUnavailable, StoreUnavailable
from l3ps_platform.workflow.planning import enqueue
from l3ps_worker import runner


def fetch(bench, job: str, target: Path) -> Path:
    """A job's files as a client downloads them."""
    for file in bench.manifest(job)["files"]:
        path = target / file["path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        bench.store.get_file(file["key"], path)
        data = path.read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (file["size"], file["sha256"])
    return target


def test_the_whole_way(direct, drive_zip: Path, fast_model: Path, log: Path, tmp_path: Path) -> None:
    """From upload to label files that score, read back from the store, just what the job says."""
    drive = direct.upload_drive(drive_zip, sha256=hashlib.sha256(drive_zip.read_bytes()).hexdigest())
    direct.upload_model(fast_model)
    job = direct.submit(drive, formats=["nuscenes", "semantickitti"])
    assert set(direct.run()) == {"done"}

    row = direct.drive(drive)
    assert (row.state, row.format, row.problem) == (DriveState.READY, "nuscenes", None)
    opened = open_drive(log)
    points = [sum(len(scan.load_points()) for scan in scene.scans) for scene in opened.scenes]
    assert [scene["points"] for scene in row.info["scenes"]] == points
    assert row.info["has_truth"]

    finished = direct.job(job)
    assert finished.state is JobState.SUCCEEDED
    files = fetch(direct, job, tmp_path / "labels")
    for side in ("primal", "refined"):
        found = evaluate_drive(opened, open_labels(files / side), "nuscenes").as_dict()
        assert finished.quality[side]["miou"] == pytest.approx(found["miou"])
        assert finished.quality[side]["pq"] == pytest.approx(found["pq"])
    assert finished.quality["refined"] != finished.quality["primal"]
    poses = read_poses(files)
    assert list(poses) == [scan.token for scene in opened.scenes for scan in scene.scans]
    assert all(np.allclose(poses[scene.scans[0].token], np.eye(4)) for scene in opened.scenes)
    assert (files / "refined" / "sequences").is_dir()
    for told, scene in zip(direct.manifest(job)["scenes"], opened.scenes, strict=True):
        assert [estimate["token"] for estimate in told["estimates"]] == [scan.token for scan in scene.scans]
        assert all(0 <= estimate["estimate"] <= 1 for estimate in told["estimates"])
        assert told["warnings"] == []

    done = direct.stages(job)
    assert {stage.state for stage in done} == {StageState.DONE}
    for stage in done:
        assert stage.seconds > 0 and stage.peak_mb > 10 and stage.fraction == 1.0
    assert sum(stage.points for stage in done if stage.name == "refine") == sum(points)


def test_the_same_again_is_not_computed_again(direct, drive_zip: Path, fast_model: Path) -> None:
    drive = direct.upload_drive(drive_zip)
    direct.upload_model(fast_model)
    first = direct.submit(drive, preset="fast")
    direct.run()
    again, other = direct.submit(drive, preset="fast"), direct.submit(drive, preset="paper")
    direct.run()
    cached = {job: [(s.name.value, s.cached) for s in direct.stages(job)] for job in (first, again, other)}
    assert not any(flag for _, flag in cached[first])
    assert all(flag for name, flag in cached[again] if name != "publish")
    # Another preset refines anew, from the same primal labels.
    assert all(flag == (name == "segment") for name, flag in cached[other])
    assert direct.job(again).quality == direct.job(first).quality
    assert direct.job(other).state is JobState.SUCCEEDED


def test_another_look_at_the_images_is_another_result(direct, drive_zip: Path, fast_model: Path) -> None:
    drive = direct.upload_drive(drive_zip)
    direct.upload_model(fast_model)
    jobs = [direct.submit(drive, preset="fast", segment=segment) for segment in ("fast", "paper", "paper")]
    direct.run()
    cached = [{s.cached for s in direct.stages(job) if s.name == "segment"} for job in jobs]
    assert cached == [{False}, {False}, {True}]
    keys = [{s.output_key for s in direct.stages(job) if s.name == "segment"} for job in jobs]
    assert keys[0] != keys[1] == keys[2]


def zip_of(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def not_an_archive(path: Path, log: Path) -> Path:
    path.write_bytes(b"this is no archive" * 100)
    return path


def empty_file(path: Path, log: Path) -> Path:
    path.write_bytes(b"")
    return path


def truncated(path: Path, log: Path) -> Path:
    whole = Path(shutil.make_archive(str(path.with_suffix("")), "zip", log))
    whole.write_bytes(whole.read_bytes()[:-5000])
    return whole


def zip_slip(path: Path, log: Path) -> Path:
    return zip_of(path, {"../../escaped.txt": b"x"})


def link_out(path: Path, log: Path) -> Path:
    path = path.with_suffix(".tar")
    with tarfile.open(path, "w") as archive:
        link = tarfile.TarInfo("data")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc"
        archive.addfile(link)
        member = tarfile.TarInfo("data/passwd")
        member.size = 1
        archive.addfile(member, io.BytesIO(b"x"))
    return path


def no_log(path: Path, log: Path) -> Path:
    return zip_of(path, {"holiday/photo.jpg": b"x"})


def no_calibration(path: Path, log: Path) -> Path:
    copy = path.parent / "copy"
    shutil.copytree(log, copy)
    next(copy.glob("v1.0-*/calibrated_sensor.json")).write_text("[]")
    return Path(shutil.make_archive(str(path.with_suffix("")), "zip", copy))


@pytest.mark.parametrize("make", [not_an_archive, empty_file, truncated, zip_slip, link_out, no_log, no_calibration])
def test_a_useless_upload_is_rejected_and_nothing_of_it_stays(direct, make, log: Path, tmp_path: Path) -> None:
    archive = make(tmp_path / "upload.zip", log)
    drive = direct.upload_drive(archive)
    assert direct.run() == ["done"]
    row = direct.drive(drive)
    assert row.state is DriveState.REJECTED
    problem = row.problem["problems"][0]
    assert problem["what"] and problem["remedy"] and problem["where"]
    assert str(tmp_path) not in json.dumps(row.problem)
    assert list(direct.store.list()) == []
    assert list((direct.settings.scratch / "cache").iterdir()) == []
    assert list((direct.settings.scratch / "work").iterdir()) == []
    assert not list(tmp_path.rglob("escaped.txt"))


def test_an_upload_other_than_announced_is_rejected(direct, drive_zip: Path) -> None:
    drive = direct.upload_drive(drive_zip, sha256="0" * 64)
    direct.run()
    assert direct.drive(drive).problem["problems"][0]["code"] == "damaged-upload"


def test_a_scan_of_three_bytes_can_be_skipped_when_asked(direct, log: Path, fast_model: Path, tmp_path: Path) -> None:
    from l3ps.errors import DriveLogError

    shutil.copytree(log, tmp_path / "copy")
    scan = open_drive(tmp_path / "copy").scenes[0].scans[1]
    scan.path.write_bytes(b"123")
    archive = Path(shutil.make_archive(str(tmp_path / "spoilt"), "zip", tmp_path / "copy"))
    drive = direct.upload_drive(archive)
    direct.upload_model(fast_model)
    direct.run()
    row = direct.drive(drive)
    assert row.state is DriveState.READY
    assert {p["scan"] for p in row.problem["problems"]} == {scan.token}
    assert [scene["scans"] for scene in row.info["scenes"]] == [1, 2]
    with pytest.raises(DriveLogError):
        direct.submit(drive)
    job = direct.submit(drive, skip_bad_scans=True, preset="fast")
    direct.run()
    assert direct.job(job).state is JobState.SUCCEEDED
    assert not any(scan.token in file["path"] for file in direct.manifest(job)["files"])


@pytest.mark.parametrize("content", [b"no zip", None], ids=["not-a-zip", "no-graph"])
def test_a_useless_model_is_rejected(direct, content: bytes | None, tmp_path: Path) -> None:
    archive = tmp_path / "upload.zip"
    archive.write_bytes(content) if content else zip_of(archive, {"model.json": b"{}"})
    model = direct.upload_model(archive)
    assert direct.run() == ["done"]
    row = direct.model(model)
    assert row.state is ModelState.REJECTED
    assert row.problem["problems"][0]["where"].startswith("upload.zip")
    assert list(direct.store.list()) == []


def test_a_model_whose_graph_does_not_load_is_rejected(direct, fast_model: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(fast_model) as good:
        info = good.read("model.json")
    model = direct.upload_model(zip_of(tmp_path / "m.zip", {"model.json": info, "model.onnx": b"garbage"}))
    direct.run()
    assert "it is no ONNX graph" in direct.model(model).problem["problems"][0]["what"]


def test_a_model_whose_trial_the_machine_ends_is_tried_again(direct, fast_model: Path, monkeypatch, tmp_path) -> None:
    """For memory that others hold, say: nothing that its owner could mend."""
    killed = tmp_path / "killed"
    killed.write_text("#!/bin/sh\nkill -KILL $$\n")
    killed.chmod(0o755)
    model = direct.upload_model(fast_model)
    message = direct.sent[0]
    with monkeypatch.context() as patched:
        patched.setattr(check.sys, "executable", str(killed))
        assert direct.step() == "failed"
    with direct.catalog.reading() as session:
        stage = stages.get(session, message.stage_id)
    assert (stage.state, stage.error["cause"], stage.failures) == (StageState.WAITING, "out-of-memory", 1)
    assert "use one with more" in stage.error["message"]
    with direct.catalog.transaction() as tx:
        enqueue(tx, stages.get(tx.session, stage.id))
    assert direct.run() == ["done"]
    assert direct.model(model).state is ModelState.READY


class TestStopping:
    """A stage ends at its next report when it is to end; nothing of it is left behind."""

    @pytest.fixture
    def ready(self, direct, drive_zip: Path, fast_model: Path):
        drive = direct.upload_drive(drive_zip)
        direct.upload_model(fast_model)
        direct.run()
        return direct, direct.submit(drive)

    def test_a_cancelled_job_stops_between_images(self, ready, monkeypatch: pytest.MonkeyPatch) -> None:
        bench, job = ready
        during(monkeypatch, runner.StageName.SEGMENT, lambda *_: bench.cancel(job))
        assert bench.step() == "cancelled"
        assert bench.job(job).state is JobState.CANCELLED
        assert bench.run() == ["not-claimed"]
        assert not list(bench.store.list("stages/"))

    def test_a_stopping_worker_gives_its_stage_back(self, ready, monkeypatch: pytest.MonkeyPatch) -> None:
        bench, job = ready
        during(monkeypatch, runner.StageName.SEGMENT, lambda *_: bench.context.stopping.set())
        assert bench.step() == "released"
        stage = next(s for s in bench.stages(job) if s.id == bench.sent[-1].stage_id)
        assert (stage.state, stage.attempt, stage.lease_owner) == (StageState.QUEUED, 1, None)

    def test_a_stage_that_another_worker_took_over_is_left_alone(self, ready, monkeypatch: pytest.MonkeyPatch) -> None:
        from l3ps_platform import workflow

        bench, job = ready
        message = bench.sent[0]

        def steal(*_: object) -> None:
            with bench.catalog.transaction() as tx:
                workflow.lease_lost(tx, message.stage_id, workflow.Retry(3, 0))

        during(monkeypatch, runner.StageName.SEGMENT, steal)
        assert bench.step() == "lost"
        stage = next(s for s in bench.stages(job) if s.id == message.stage_id)
        assert (stage.state, stage.attempt) == (StageState.WAITING, 2)


def during(monkeypatch: pytest.MonkeyPatch, name, action) -> None:
    """Do something when the stage makes its first report."""
    work, steps = runner.WORK[name]

    def disturbed(context, claim, progress):
        first = []

        def report(*args) -> None:
            if not first:
                first.append(action())
            progress(*args)

        return work(context, claim, report)

    monkeypatch.setitem(runner.WORK, name, (disturbed, steps))


@pytest.mark.parametrize(
    ("error", "cause", "failures", "said"),
    [
        (MemoryError(), "out-of-memory", 1, "out of memory"),
        (StoreUnavailable("the store is away"), "store-unavailable", 0, "the store is away"),
        (ZeroDivisionError("division by zero"), "internal", 1, "ZeroDivisionError: division by zero"),
        (OSError(errno.ENOSPC, "No space left"), "disk-full", 0, "the disk is full"),
    ],
    ids=["memory", "store", "bug", "disk"],
)
def test_what_may_pass_is_tried_again(direct, drive_zip: Path, monkeypatch, error, cause, failures, said) -> None:
    def broken(*_: object) -> None:
        raise error

    monkeypatch.setitem(runner.WORK, runner.StageName.INGEST, (broken, ()))
    drive = direct.upload_drive(drive_zip)
    assert direct.step() == "failed"
    with direct.catalog.reading() as session:
        stage = stages.ingest_of(session, drive_id=drive)
    assert (stage.state, stage.attempt, stage.failures) == (StageState.WAITING, 2, failures)
    assert (stage.error["cause"], stage.finished_at) == (cause, None)
    assert said in stage.error["message"]


def test_an_end_that_cannot_be_recorded_is_a_failure_of_the_stage(direct, drive_zip: Path, monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ValueError("the database does not take this")

    monkeypatch.setattr(workflow, "drive_checked", refuse)
    drive = direct.upload_drive(drive_zip)
    assert direct.step() == "failed"
    with direct.catalog.reading() as session:
        stage = stages.ingest_of(session, drive_id=drive)
    assert (stage.state, stage.failures, stage.error["cause"]) == (StageState.WAITING, 1, "internal")
    assert stage.error["message"] == "what it found could not be recorded (ValueError)"


def test_what_is_done_waits_for_a_catalog_that_is_away(direct, drive_zip: Path, monkeypatch) -> None:
    """The work is not lost with the first commit that fails, nor is a claim whose answer alone is lost."""
    drive, real, failures = direct.upload_drive(drive_zip), direct.context.catalog, [1, 2]
    unanswered = [1]

    class Away:
        """The catalog, away after its first commit, and for two transactions once the stage's work is done."""

        def __getattr__(self, name: str):
            return getattr(real, name)

        @contextmanager
        def transaction(self):
            if done and failures:
                failures.pop()
                raise CatalogUnavailable("the catalog does not answer")
            with real.transaction() as tx:
                yield tx
            if unanswered:
                unanswered.pop()
                raise CatalogUnavailable("the catalog does not answer")

    done: list[bool] = []
    work, steps = runner.WORK[runner.StageName.INGEST]

    def noted(*given):
        result = work(*given)
        done.append(True)
        return result

    monkeypatch.setitem(runner.WORK, runner.StageName.INGEST, (noted, steps))
    direct.context.catalog = Away()
    assert direct.step() == "done"
    assert not failures + unanswered
    assert direct.drive(drive).state is DriveState.READY


def test_an_archive_that_reads_otherwise_than_checked_is_the_store_s_fault(
    direct, drive_zip: Path, short_zip: Path, fast_model: Path
) -> None:
    drive = direct.upload_drive(drive_zip)
    direct.upload_model(fast_model)
    direct.run()
    shutil.rmtree(direct.settings.scratch / "cache")
    (direct.settings.scratch / "cache").mkdir()
    job = direct.submit(drive)
    direct.store.put_file(direct.drive(drive).object_key, short_zip)
    assert direct.step() == "failed"
    stage = direct.stages(job)[0]
    assert (stage.state, stage.error["cause"]) == (StageState.WAITING, "store-unavailable")
    direct.store.put_file(direct.drive(drive).object_key, drive_zip)
    assert direct.step() == "done"


def test_bad_input_found_late_is_not_tried_again(direct, drive_zip: Path, fast_model: Path, monkeypatch) -> None:
    from l3ps.errors import DriveLogError, Problem

    drive = direct.upload_drive(drive_zip)
    direct.upload_model(fast_model)
    direct.run()
    job = direct.submit(drive)
    problem = Problem("truncated-image", "a.jpg", "it ends early", "Copy it again.")

    def broken(*_: object) -> None:
        raise DriveLogError(problem)

    monkeypatch.setitem(runner.WORK, runner.StageName.SEGMENT, (broken, ()))
    assert set(direct.run()) == {"failed"}
    row = direct.job(job)
    assert row.state is JobState.FAILED
    assert row.error["problems"][0] == problem.as_dict()
    assert row.error["message"].startswith("2 of 2 scenes failed")


def test_a_drive_s_log_is_fetched_again_when_the_scratch_lost_it(direct, drive_zip: Path, fast_model: Path) -> None:
    drive = direct.upload_drive(drive_zip)
    direct.upload_model(fast_model)
    direct.run()
    shutil.rmtree(direct.settings.scratch / "cache")
    (direct.settings.scratch / "cache").mkdir()
    direct.submit(drive)
    assert direct.step() == "done"


def test_what_a_stage_makes_stays_while_a_job_that_was_not_deleted_uses_it(
    direct, short_zip: Path, fast_model: Path
) -> None:
    drive = direct.upload_drive(short_zip)
    direct.upload_model(fast_model)
    first, second = (direct.submit(drive, preset="fast") for _ in range(2))
    assert set(direct.run()) == {"done"}
    made = {info.key for info in direct.store.list("stages/")}
    sweeper = workflow.Sweeper(direct.catalog, direct.store, direct.settings)
    for job, left in ((first, made), (second, set())):
        with direct.catalog.transaction() as tx:
            jobs.delete(tx, job)
        with direct.catalog.reading() as session:
            sizes = outputs.stored_bytes(session) - direct.drive(drive).size
        assert sizes >= sum(direct.store.stat(key).size for key in made if not key.endswith("scene.json"))
        sweeper.run_once()
        assert {info.key for info in direct.store.list("stages/")} == left
    assert list(direct.store.list("jobs/")) == []
