"""Real Celery workers on a real Redis, killed in every way."""

import hashlib
import os
import signal
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import JobState, ModelState, StageName, StageState, stages

pytestmark = pytest.mark.services


def at_work(bench, job: str, attempt: int = 1):
    """The job's segment stage that is running at this attempt and has reported, or None."""
    running = (s for s in bench.stages(job) if s.name is StageName.SEGMENT and s.state is StageState.RUNNING)
    return next((s for s in running if s.attempt == attempt and s.progress_done), None)


def child_of(stage) -> int:
    return int(stage.lease_owner.rpartition(":")[2])


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_two_workers_on_postgresql_and_minio(
    served, worker, drive_zip: Path, fast_model: Path, postgres_url: str, s3_url: str
) -> None:
    """One for each queue; the files come back through presigned URLs."""
    with served(database_url=postgres_url, objects_url=s3_url) as bench:
        worker(bench, "segment")
        worker(bench, "refine")
        drive, _ = bench.upload_drive(drive_zip), bench.upload_model(fast_model)
        job = bench.finished(bench.submit(drive, preset="fast"))
        assert (job.state, job.error) == (JobState.SUCCEEDED, None)
        assert job.quality["protocol"] == "nuscenes"
        file = next(f for f in bench.manifest(job.id)["files"] if f["path"].startswith("refined/panoptic"))
        reply = httpx.get(bench.store.presign_get(file["key"], 60))
        assert hashlib.sha256(reply.content).hexdigest() == file["sha256"]


def test_a_job_survives_all_that_can_happen_to_its_workers(served, worker, short_zip: Path, slow_model: Path) -> None:
    """One scene, met at work four times: its child is killed, its worker is told to stop, gently and less so, and at
    last killed. The lease of two minutes is never waited for, and only the two kills count as attempts.
    """
    with served() as bench:
        current = worker(bench)
        drive, _ = bench.upload_drive(short_zip), bench.upload_model(slow_model)
        job = bench.submit(drive, preset="fast")

        os.kill(child_of(bench.until(lambda: at_work(bench, job, attempt=1))), signal.SIGKILL)
        for stop in (signal.SIGTERM, signal.SIGQUIT):
            stage = bench.until(lambda: at_work(bench, job, attempt=2))
            current.send_signal(stop)
            current.wait(30)
            given_back = next(s for s in bench.stages(job) if s.id == stage.id)
            assert (given_back.state, given_back.attempt) == (StageState.QUEUED, 2), stop.name
            assert not alive(child_of(stage))
            current = worker(bench)

        stage = bench.until(lambda: at_work(bench, job, attempt=2))
        current.kill()
        current.wait()
        bench.until(lambda: not alive(child_of(stage)))
        worker(bench)
        assert bench.finished(job).state is JobState.SUCCEEDED
        assert next(s for s in bench.stages(job) if s.id == stage.id).attempt == 3


def test_a_worker_holds_what_it_works_on_and_takes_nobody_s(served, worker, fast_model: Path, drive_zip: Path) -> None:
    """A child that cannot record how its stage ended lets go of it; and a worker that shares its host name with another
    one, in a container whose processes it does not see, takes that one's stages neither at its start nor later.
    """
    with served(heartbeat_seconds=0.2) as bench:
        drive = bench.upload_drive(drive_zip)
        neighbour = f"{socket.gethostname()}:{1 << 23}:other:{1 << 23}"
        with bench.catalog.transaction() as tx:
            check = stages.ingest_of(tx.session, drive_id=drive)
            assert workflow.claim(tx, check.id, check.attempt, neighbour, lease_seconds=3600.0)
        model = bench.upload_model(fast_model)
        worker(bench, app="unrecordable", PYTHONPATH=str(Path(__file__).parent))
        bench.until(lambda: bench.model(model).state is ModelState.READY)
        with bench.catalog.reading() as session:
            done, held = stages.ingest_of(session, model_id=model), stages.get(session, check.id)
        assert (done.attempt, held.state, held.lease_owner) == (2, StageState.RUNNING, neighbour)


def pulse_of(worker_pid: int) -> int | None:
    """The worker's pulse among its children, whichever of its threads started it."""
    for task in Path(f"/proc/{worker_pid}/task").iterdir():
        for pid in (task / "children").read_text().split():
            if "l3ps_worker.pulse" in Path(f"/proc/{pid}/cmdline").read_text():
                return int(pid)
    return None


def test_a_stage_deep_in_compiled_code_keeps_its_lease(served, worker, short_zip: Path, slow_model: Path) -> None:
    """A stopped child can send no sign of life, like one whose clusterer holds the interpreter lock for minutes."""
    # Seldom progress: a child stopped in the midst of writing would hold SQLite's lock.
    with served(lease_seconds=5.0, heartbeat_seconds=0.5, progress_seconds=2.0) as bench:
        process = worker(bench)
        drive, _ = bench.upload_drive(short_zip), bench.upload_model(slow_model)
        job = bench.submit(drive, preset="fast")
        stage = bench.until(lambda: at_work(bench, job))
        os.kill(child_of(stage), signal.SIGSTOP)
        outlived = bench.until(lambda: at_work(bench, job)).lease_until + timedelta(seconds=1)
        bench.until(lambda: datetime.now(UTC) > outlived)
        assert at_work(bench, job).lease_owner == stage.lease_owner
        os.kill(child_of(stage), signal.SIGCONT)
        assert bench.finished(job).state is JobState.SUCCEEDED
        assert next(s for s in bench.stages(job) if s.id == stage.id).attempt == 1

        killed = pulse_of(process.pid)
        os.kill(killed, signal.SIGKILL)
        bench.until(lambda: pulse_of(process.pid) not in (None, killed))


def test_a_cancelled_job_stops_in_a_real_worker(served, worker, short_zip: Path, slow_model: Path) -> None:
    with served() as bench:
        worker(bench)
        drive, _ = bench.upload_drive(short_zip), bench.upload_model(slow_model)
        job = bench.submit(drive, preset="fast")
        bench.until(lambda: at_work(bench, job))
        bench.cancel(job)
        assert bench.finished(job).state is JobState.CANCELLED


def test_a_stage_that_takes_too_long_is_stopped_with_that_reason(
    served, worker, short_zip: Path, stuck_model: Path
) -> None:
    with served(stage_seconds=3.0, max_attempts=1) as bench:
        worker(bench)
        drive, _ = bench.upload_drive(short_zip), bench.upload_model(stuck_model)
        job = bench.finished(bench.submit(drive, preset="fast"))
        assert job.state is JobState.FAILED
        assert "ran for more than 3 s" in job.error["message"]


def test_a_child_that_goes_on_after_its_job_was_cancelled_is_killed(
    served, worker, short_zip: Path, slow_model: Path
) -> None:
    """A stopped child hears nothing, like one deep in compiled code; its worker goes on without it."""
    with served(cancel_seconds=0.5, heartbeat_seconds=0.2, progress_seconds=2.0) as bench:
        process = worker(bench)
        drive, _ = bench.upload_drive(short_zip), bench.upload_model(slow_model)
        job = bench.submit(drive, preset="fast")
        stage = bench.until(lambda: at_work(bench, job))
        os.kill(child_of(stage), signal.SIGSTOP)
        bench.cancel(job)
        assert bench.finished(job).state is JobState.CANCELLED
        assert not alive(child_of(stage))
        killed = next(s for s in bench.stages(job) if s.id == stage.id)
        assert (killed.state, killed.error["cause"]) == (StageState.CANCELLED, "cancelled")
        assert process.poll() is None
