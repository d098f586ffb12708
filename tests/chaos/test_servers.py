"""Queue, object store, catalog and disk that go away, come back, stammer and fill up."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from chaoslib.proxy import Rule
from chaoslib.servers import wait_until
from chaoslib.workload import CASES

from l3ps_platform.catalog import StageName, StageRow, StageState

AWAY_SECONDS = 4.0
"""Longer than a lease of these scenarios, and than all the retries of a request."""


def outlast(seconds: float) -> None:
    """An outage is a stretch of time; there is nothing to wait for."""
    time.sleep(seconds)


def test_redis_killed(scenario, ends_well) -> None:
    """kill -9 of Redis in mid-job, started again after 4 s with its append-only file."""
    service = scenario(aof=True)
    service.begin()
    service.start_worker("w1", concurrency=2)
    service.at_work("segment")
    service.servers.redis.kill()
    outlast(AWAY_SECONDS)
    service.servers.redis.start()
    ends_well(service)


def test_redis_killed_and_emptied(scenario, ends_well) -> None:
    """kill -9 of Redis in mid-job, started again after 4 s without any data."""
    service = scenario(aof=False)
    service.begin()
    service.start_worker("w1", concurrency=2)
    service.at_work("segment")
    service.servers.redis.kill()
    service.servers.redis.forget()
    outlast(AWAY_SECONDS)
    service.servers.redis.start()
    ends_well(service)


class Outage:
    """The store is killed at a moment that a rule chooses, and started again a while later."""

    def __init__(self, seconds: float = AWAY_SECONDS) -> None:
        self._seconds = seconds
        self.happened = False

    def __call__(self) -> None:
        self.service.note_in_flight()
        minio = self.service.servers.minio
        minio.kill()
        outlast(self._seconds)
        minio.start()
        self.happened = True


@pytest.mark.parametrize(
    ("method", "pattern", "nth"),
    [
        ("GET", "uploads/", [3]),
        ("GET", r"primal\.npz", [2]),
        ("PUT", r"primal\.npz", [3]),
        ("PUT", r"refine-.*(_panoptic\.npz|\.label)", [5]),
        ("PUT", r"jobs/.*/manifest\.json", [1]),
    ],
    ids=["at-read-of-an-archive", "at-read-of-labels", "at-write", "at-write-of-labels", "before-the-manifest"],
)
def test_store_down(scenario, ends_well, method: str, pattern: str, nth: list[int]) -> None:
    """kill -9 of the object store at a certain request, started again after 4 s; no attempt is used up."""
    outage = Outage()
    rule = Rule(method, pattern, nth, before=outage, armed=False)
    service = scenario(rules=[rule])
    outage.service = service
    service.begin()
    rule.armed = True  # the API looks into what was uploaded, too
    service.start_worker(concurrency=2)
    ends_well(service)
    assert outage.happened
    assert scenario.facts["failures counted"] == 0


def test_killed_behind_the_manifest(scenario, ends_well) -> None:
    """kill -9 of the worker's child when a manifest is stored and not yet in the catalog."""

    def kill() -> None:
        service.note_in_flight()
        running = service.stages(StageRow.name == StageName.PUBLISH, StageRow.state == StageState.RUNNING)
        os.kill(service.child_of(running[0]), signal.SIGKILL)

    service = scenario(rules=[Rule("PUT", r"jobs/.*/manifest\.json", [1, 4], after=kill)])
    service.begin()
    service.start_worker()
    ends_well(service)
    assert scenario.facts["failures counted"] == 2


def test_store_slow(scenario, ends_well) -> None:
    """Every request to the object store takes 0.15 s longer."""
    rules = [Rule(method, "", delay=0.15) for method in ("GET", "PUT", "HEAD")]
    service = scenario(rules=rules)
    service.begin()
    service.start_worker(concurrency=2)
    service.at_work("segment")
    ends_well(service)
    assert scenario.facts["attempts beyond the first"] == 0


def test_store_truncates(scenario, ends_well) -> None:
    """Bodies that end half way: of archives, the model, primal labels and manifests."""
    patterns = {r"uploads/.*": [1, 3], r"primal\.npz": [1, 4], r"scene\.json": [30, 33]}
    rules = [Rule("GET", pattern, nth, truncate=True, armed=False) for pattern, nth in patterns.items()]
    service = scenario(rules=rules)
    service.begin()
    for rule in rules:
        rule.armed = True
    service.start_worker(concurrency=2)
    service.at_work("segment")
    ends_well(service)
    assert all(rule.hits for rule in rules)
    assert scenario.facts["failures counted"] == 0


def test_database_restarted(scenario, ends_well) -> None:
    """kill -9 of PostgreSQL in mid-job, started again after 4 s, which is longer than a lease."""
    service = scenario(faults=[{"stage": "refine", "fault": "slow", "seconds": 1.0, "nth": [1, 2]}])
    service.begin()
    service.start_worker("w1")
    service.start_worker("w2")
    service.at_work("refine")
    service.servers.postgres.kill()
    outlast(AWAY_SECONDS)
    service.servers.postgres.start_again()
    ends_well(service)
    assert scenario.facts["failures counted"] == 0  # what ran went on, and leases were borne


def test_database_killed_everywhere(scenario, ends_well) -> None:
    """kill -9 of PostgreSQL in an ingest, in a publish stage and while a client submits jobs; 4 s away each time."""
    faults = [{"stage": name, "fault": "slow", "seconds": 1.0, "nth": [2]} for name in ("ingest", "publish")]
    service = scenario(faults=faults, idempotency_lease_seconds=2.0)
    service.begin()
    service.patient = True
    submitting = threading.Thread(target=lambda: [service.submit(case) for case in CASES])

    def away() -> None:
        service.servers.postgres.kill()
        outlast(AWAY_SECONDS)
        service.servers.postgres.start_again()

    service.start_worker(concurrency=2)
    service.at_work("ingest")
    away()
    submitting.start()
    wait_until(lambda: len(service.jobs) > len(CASES) + 2, "no job was submitted", 60)
    away()
    service.at_work("publish")
    away()
    submitting.join(120)
    ends_well(service)
    assert len(service.all_jobs()) == len(service.jobs) == 2 * len(CASES), "a job was made twice, or not at all"
    assert scenario.facts["failures counted"] == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 12 MB: six drives of 1.6 MB, packed and unpacked, are more than it holds."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", folder], check=False)
    if mounted.returncode:
        pytest.skip("only root may mount a small file system")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_disk_full(scenario, ends_well, small_disk: Path) -> None:
    """A scratch of 12 MB that others fill to the last byte for 3 s in mid-job, and that never holds every drive."""
    service = scenario(scratch_dir=small_disk, faults=[{"stage": "segment", "fault": "slow", "seconds": 0.2}])
    service.begin()
    service.start_worker(concurrency=2)
    service.at_work("segment")
    ballast = (small_disk / "ballast").open("ab", buffering=0)

    def met() -> bool:
        with suppress(OSError):
            while True:  # also what the workers free
                ballast.write(b"x" * (1 << 14))
        return bool(service.stages(StageRow.error["cause"].as_string() == "disk-full"))

    wait_until(met, "nobody met the full disk", 60)
    outlast(3.0)
    ballast.close()
    (small_disk / "ballast").unlink()
    ends_well(service)
    assert scenario.facts["failures counted"] == 0
