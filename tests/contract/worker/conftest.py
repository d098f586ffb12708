"""A small simulated drive, small networks, and workers: in this process and as real ones."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from l3ps.simulate import simulate_drive
from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Catalog,
    DriveRow,
    JobRow,
    ModelRow,
    StageMessage,
    StageRow,
    bundles,
    drives,
    jobs,
    stages,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.objects import ObjectStore
from l3ps_platform.settings import Settings
from l3ps_worker.context import Context
from l3ps_worker.runner import run_stage

SCENES, SCANS = 2, 2
CLASSES = {"road": 11, "plants": 16, "sky": 0}


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive of two scenes with truth."""
    folder = tmp_path_factory.mktemp("log") / "drive"
    simulate_drive(folder, scenes=SCENES, scans=SCANS, seed=11)
    return folder


@pytest.fixture(scope="session")
def drive_zip(log: Path) -> Path:
    """The drive as an archive."""
    return Path(shutil.make_archive(str(log.parent / "drive"), "zip", log))


def bundle_zip(path: Path, layers: int, height: int, width: int) -> Path:
    """A network that tells three classes by colour, made slow by ``layers`` convolutions that change nothing."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, height, width])
    same = np.zeros((3, 3, 9, 9), np.float32)
    same[range(3), range(3), 4, 4] = 1
    names = ["image", *(f"x{n}" for n in range(layers))]
    nodes = [helper.make_node("Conv", [a, "same"], [b], pads=[4] * 4) for a, b in pairwise(names)]
    nodes.append(helper.make_node("Identity", names[-1:], ["logits"]))
    graph = helper.make_graph(nodes, "colours", [image], [logits], [numpy_helper.from_array(same, "same")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    info = {
        "name": "colours",
        "input": {"name": "image", "height": height, "width": width, "range": "0..1"},
        "output": {"semantic": "logits"},
        "classes": list(CLASSES),
        "to_nuscenes": CLASSES,
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model.onnx", model.SerializeToString())
        archive.writestr("model.json", json.dumps(info))
    return path


@pytest.fixture(scope="session")
def fast_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Milliseconds an image."""
    return bundle_zip(tmp_path_factory.mktemp("model") / "fast.zip", 0, 32, 64)


@pytest.fixture(scope="session")
def slow_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tenths of a second an image: long enough to be met at work."""
    return bundle_zip(tmp_path_factory.mktemp("model") / "slow.zip", 8, 256, 512)


@pytest.fixture(scope="session")
def stuck_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About a second an image: passes its check in time, but will not finish a scene while a test waits."""
    return bundle_zip(tmp_path_factory.mktemp("model") / "stuck.zip", 60, 512, 512)


@pytest.fixture(scope="session")
def short_zip(log: Path) -> Path:
    """An archive of the drive's first scene only."""
    copy = log.parent / "short"
    shutil.copytree(log, copy)
    scenes = next(copy.glob("v1.0-*/scene.json"))
    scenes.write_text(json.dumps(json.loads(scenes.read_text())[:1]))
    return Path(shutil.make_archive(str(copy), "zip", copy))


class Bench:
    """The service without an API: uploads straight into the store, jobs straight into the catalog."""

    def __init__(self, settings: Settings, store: ObjectStore, catalog: Catalog) -> None:
        self.settings, self.store, self.catalog = settings, store, catalog.scoped(DEFAULT_PROJECT)

    def upload_drive(self, archive: Path, **given: str) -> str:
        key = f"uploads/{tempfile.mktemp(dir='').strip('/')}/{archive.name}"
        self.store.put_file(key, archive)
        with self.catalog.transaction() as tx:
            size = archive.stat().st_size
            return workflow.accept_drive(tx, name="d", filename=archive.name, size=size, object_key=key, **given).id

    def upload_model(self, archive: Path, name: str = "m", **given: str) -> str:
        key = f"uploads/{name}/{archive.name}"
        self.store.put_file(key, archive)
        with self.catalog.transaction() as tx:
            size = archive.stat().st_size
            return workflow.accept_model(tx, name=name, filename=archive.name, size=size, object_key=key, **given).id

    def submit(self, drive: str, model: str = "m", **settings: object) -> str:
        with self.catalog.transaction() as tx:
            return workflow.submit_job(tx, drive_id=drive, model=model, **settings).id

    def cancel(self, job: str) -> None:
        with self.catalog.transaction() as tx:
            workflow.cancel_job(tx, job)

    def drive(self, id: str) -> DriveRow:
        with self.catalog.reading() as session:
            return drives.get(session, id)

    def model(self, id: str) -> ModelRow:
        with self.catalog.reading() as session:
            return bundles.get(session, id)

    def job(self, id: str) -> JobRow:
        with self.catalog.reading() as session:
            return jobs.get(session, id)

    def stages(self, job: str) -> list[StageRow]:
        with self.catalog.reading() as session:
            return stages.of_job(session, job)

    def manifest(self, job: str) -> dict:
        return json.loads(self.store.get_bytes(f"jobs/{job}/manifest.json"))

    def until(self, ready: Callable[[], object], seconds: float = 90.0) -> object:
        """Wait for something to be true; its value."""
        deadline = time.monotonic() + seconds
        while not (found := ready()):
            assert time.monotonic() < deadline, "it did not happen in time"
            time.sleep(0.05)
        return found

    def finished(self, job: str) -> JobRow:
        self.until(lambda: self.job(job).state.final)
        return self.job(job)


class DirectBench(Bench):
    """Stages run in this process, one after the other, when the test says so."""

    def __init__(self, settings: Settings) -> None:
        self.sent: list[StageMessage] = []
        self.context = Context(settings)
        self.context.catalog = Catalog(settings.catalog_url, self.sent.extend)
        super().__init__(settings, self.context.store, self.context.catalog)

    def step(self) -> str:
        """Run the next stage; how it ended."""
        message = self.sent.pop(0)
        return run_stage(self.context, message.stage_id, message.attempt)

    def run(self) -> list[str]:
        """Run stages until no message is left; how they ended."""
        ends = []
        while self.sent:
            ends.append(self.step())
        return ends


@pytest.fixture
def direct(tmp_path: Path) -> Iterator[DirectBench]:
    """A bench on SQLite and a directory."""
    settings = Settings(data_dir=tmp_path / "data", progress_seconds=0, threads=1)
    upgrade(settings.catalog_url)
    bench = DirectBench(settings)
    bench.store.ensure()
    yield bench
    bench.context.close()


@pytest.fixture
def served(tmp_path: Path, redis_url: str) -> Iterator[Callable]:
    """Benches on a real Redis with a reconciler: ``with served(database_url=…, objects_url=…) as bench``."""

    @contextmanager
    def serve(**places: Any) -> Iterator[Bench]:
        quick = {"progress_seconds": 0.0, "reconcile_seconds": 0.2, "retry_seconds": 0.1}
        settings = Settings(data_dir=tmp_path / "data", redis_url=redis_url, threads=1, **(quick | places))
        upgrade(settings.catalog_url)
        context = Context(settings)
        context.store.ensure()
        stop = threading.Event()
        reconciler = workflow.Reconciler(context.catalog, context.queue, settings)
        thread = threading.Thread(target=reconciler.run, args=(stop,))
        thread.start()
        try:
            yield Bench(settings, context.store, context.catalog)
        finally:
            stop.set()
            thread.join()
            context.close()

    return serve


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts real worker processes for a bench: ``worker(bench, queues=…, app=…)``; none survives the test."""
    running: list[subprocess.Popen[bytes]] = []

    def start(
        bench: Bench, queues: str = "segment,refine", app: str = "l3ps_worker.app", **extra: str
    ) -> subprocess.Popen[bytes]:
        given = bench.settings.model_dump(exclude_unset=True, exclude_none=True)
        environment = os.environ | {f"L3PS_{name.upper()}": str(value) for name, value in given.items() if value != ""}
        command = [sys.executable, "-m", "celery", "-A", app, "worker", "-Q", queues, "-c", "1"]
        command += ["--without-gossip", "--without-mingle"]  # a second less to start
        out = (tmp_path / f"worker-{len(running)}.log").open("wb")
        process = subprocess.Popen(
            command, env=environment | extra, stdout=out, stderr=out, cwd=tmp_path, start_new_session=True
        )
        out.close()
        running.append(process)
        return process

    yield start
    for process in running:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    for log_file in sorted(tmp_path.glob("worker-*.log")):
        print(f"--- {log_file.name}\n{log_file.read_text(errors='replace')[-4000:]}")  # noqa: T201  (pytest shows it on failure)
