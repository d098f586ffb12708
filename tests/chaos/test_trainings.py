"""A training beside the jobs, killed in the middle with the real trainer."""

import hashlib
import io
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from chaoslib.servers import descendants, wait_until

from l3ps_platform.catalog import JobState, ModelState, StageName, StageRow, StageState, TrainingRow
from l3ps_worker.keys import trainer_version

SETTINGS = {"backbone": "scratch", "size": [64, 96], "epochs": 40, "images": 4}


@pytest.fixture
def undisturbed(work, tmp_path: Path) -> str:
    """Digest of the network that the same training gives where nobody disturbs it; kept as the baseline is."""
    kept = os.environ.get("L3PS_CHAOS_CACHE")
    cache = Path(kept or tmp_path, f"training-{trainer_version()[:16]}-{SETTINGS['epochs']}.txt")
    if not cache.exists():
        cache.write_text(_train(work, tmp_path))
    return cache.read_text()


def _train(work, tmp_path: Path) -> str:
    with zipfile.ZipFile(io.BytesIO(work.annotations)) as archive:
        archive.extractall(tmp_path / "images")
    options = [f"--{name}={value}" for name, value in {**SETTINGS, "size": "64x96", "name": "trained"}.items()]
    command = ["train", "images", "--out=out", "--threads=1", "--seed=0", "--format=auto", *options]
    subprocess.run([sys.executable, "-P", "-m", "l3ps_trainer", *command], cwd=tmp_path, check=True, timeout=120)
    return hashlib.sha256((tmp_path / "out" / "model.onnx").read_bytes()).hexdigest()


def test_training_killed(scenario, ends_well, undisturbed: str) -> None:
    """kill -9 in mid-training of the trainer, then of the child that watches over it, then of its whole worker.

    All jobs are under way meanwhile. The model is that of an undisturbed training.
    """
    service = scenario(max_attempts=4, checkpoint_seconds=1.0, training="1")
    service.begin()
    annotations = service.upload(service.workload.annotations, "four.zip", "annotations")
    training = service.post("/v1/models/train", name="trained", annotations=annotations, **SETTINGS)["id"]
    trainer = service.start_worker("trainer", queues="train")

    def trains(attempt: int) -> StageRow:
        begun = (StageRow.attempt == attempt, StageRow.state == StageState.RUNNING)
        at_it = (StageRow.name == StageName.TRAIN, *begun, StageRow.progress_step == "train")
        return wait_until(lambda: service.stages(*at_it), f"attempt {attempt} did not train", 90)[0]

    watcher = service.child_of(trains(1))
    service.note_in_flight()
    service.start_worker(concurrency=2)
    os.kill(descendants(watcher)[0], signal.SIGKILL)
    os.kill(service.child_of(trains(2)), signal.SIGKILL)
    trains(3)
    service.kill(trainer)
    service.start_worker("trainer", queues="train")
    service.wait()
    row = service.rows(TrainingRow, TrainingRow.id == training)[0]
    assert row.state is JobState.SUCCEEDED, row.error
    model = service.http.get("/v1/models/trained").json()
    assert model["state"] == ModelState.READY
    stage = service.stages(StageRow.name == StageName.TRAIN)[0]
    with zipfile.ZipFile(io.BytesIO(service.store.get_bytes(_bundle(service)))) as bundle:
        assert hashlib.sha256(bundle.read("model.onnx")).hexdigest() == undisturbed
    assert stage.attempt == 4
    ends_well(service)


def _bundle(service) -> str:
    return next(info.key for info in service.store.list("stages/") if info.key.endswith("/bundle.zip"))
