"""The real API in a real process, with everything it stands on, and eyes into its catalog and store."""

import json
import os
import secrets
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import psycopg
import pytest
from fastapi.testclient import TestClient
from onnx import TensorProto, helper, numpy_helper
from tests.conftest import wait_until
from tests.contract.api.receivers import delivered, hooked, ping, receiver  # noqa: F401  (fixtures)
from typer.testing import CliRunner

from l3ps_api.app import create_app
from l3ps_cli.main import app
from l3ps_cli.packing import pack_bundle, pack_log
from l3ps_cli.processes import Processes
from l3ps_cli.stack import QUEUES, STOP_WORKER, TRAINER_QUEUES, WORKER, Stack, StackOptions, free_port
from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Catalog,
    DriveState,
    ModelState,
    StageState,
    bundles,
    drives,
    stages,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.settings import Settings

MiB = 1 << 20
TUNING = {
    **{"L3PS_PART_BYTES": str(5 * MiB), "L3PS_MAX_MODEL_BYTES": str(8 * MiB), "L3PS_RECONCILE_SECONDS": "0.5"},
    **{"L3PS_WEBHOOK_ALLOW": "127.0.0.1/32", "L3PS_WEBHOOK_HTTP": "1"},
    **{"L3PS_WEBHOOK_RETRY_SECONDS": "0,0.1,0.1", "L3PS_WEBHOOK_TIMEOUT_SECONDS": "3"},
    "L3PS_LOG_FORMAT": "json",  # test_logs reads them
}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what costs seconds where it would only cost them twice."""
    twice = [item for item in items if item.get_closest_marker("once") and item.callspec.params["service"] != "servers"]
    items[:] = [item for item in items if item not in twice]
    config.hook.pytest_deselected(items=twice)


@dataclass
class Service:
    """A running service as a client sees it, with its catalog and object store for looking behind the curtain."""

    http: httpx.Client
    catalog: Catalog
    store: ObjectStore
    settings: Settings

    @property
    def url(self) -> str:
        return str(self.http.base_url).rstrip("/")

    @property
    def token(self) -> str:
        """The operator's."""
        assert self.settings.token is not None
        return self.settings.token.get_secret_value()

    def announce(self, size: int, filename: str = "log.tar", kind: str = "drive") -> dict:
        answer = self.http.post("/v1/uploads", json={"kind": kind, "filename": filename, "size": size})
        assert answer.status_code == 201, answer.text
        return answer.json()

    def put_parts(self, upload: dict, data: bytes) -> list[dict]:
        size = upload["part_size"]
        tags = []
        for part in upload["parts"]:
            start = (part["number"] - 1) * size
            answer = httpx.put(part["url"], content=data[start : start + size])
            assert answer.status_code == 200, answer.text
            tags.append({"number": part["number"], "etag": answer.headers["etag"]})
        return tags

    def upload(self, data: bytes, filename: str = "log.tar", kind: str = "drive", **completion) -> httpx.Response:
        """The whole upload; the answer to its completion."""
        upload = self.announce(len(data), filename, kind)
        parts = self.put_parts(upload, data)
        return self.http.post(f"/v1/uploads/{upload['id']}/complete", json={"parts": parts, **completion})

    def wait(self, path: str, until: Callable[[dict], bool], seconds: float = 120) -> dict:
        """The document at a path once it is as wanted."""
        document: dict = wait_until(lambda: self.http.get(path).json(), until, seconds)
        return document

    until = staticmethod(wait_until)

    def wait_for_drive(self, drive_id: str) -> dict:
        """A drive once it has been checked."""
        return self.wait(f"/v1/drives/{drive_id}", lambda drive: drive["state"] in ("ready", "rejected"))

    def wait_for_job(self, job_id: str) -> dict:
        """A job once it is over."""
        return self.wait(f"/v1/jobs/{job_id}", _over)

    def wait_for_training(self, training_id: str) -> dict:
        """A training once it is over."""
        return self.wait(f"/v1/trainings/{training_id}", _over)

    def objects(self) -> set[str]:
        """Keys of all uploaded archives; a worker may be writing outputs of other tests' jobs meanwhile."""
        return {info.key for info in self.store.list("uploads/")}

    @staticmethod
    def refused(answer: httpx.Response, status: int, code: str) -> dict:
        """The problem document of an answer, which must be of this kind and complete enough to act on."""
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        document = answer.json()
        assert document["type"] == f"urn:l3ps:problem:{code}"
        assert document["status"] == status
        assert document["instance"] == answer.request.url.path
        assert document["title"] and document["detail"]
        assert document["errors"], "every problem names what is at fault"
        for error in document["errors"]:
            assert error["where"] and error["what"] and error["remedy"]
        return document


def _over(document: dict) -> bool:
    return document["state"] in ("succeeded", "failed", "cancelled")


@pytest.fixture(scope="session", params=["embedded", "servers"])
def service(request, tmp_path_factory) -> Iterator[Service]:
    """The service twice: as ``l3ps up`` runs it, and on PostgreSQL, MinIO and a Redis server."""
    data = tmp_path_factory.mktemp("service")
    start = _embedded if request.param == "embedded" else _servers
    with start(request, data) as settings, _looked_into(settings) as service:
        yield service


@contextmanager
def _embedded(request, data, training: bool = True) -> Iterator[Settings]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in TUNING.items():
            patch.setenv(name, value)
        with Stack(StackOptions(data, port=0, training=training)) as stack:
            yield Settings(data_dir=data, port=int(stack.url.rpartition(":")[2]), token=stack.token)


@contextmanager
def _servers(request, data, redis_database: int = 1) -> Iterator[Settings]:
    postgres, minio, redis = map(request.getfixturevalue, ("postgres_server", "minio_server", "redis_server"))
    with psycopg.connect(postgres.get_uri(), autocommit=True) as connection:
        database = f"service_{redis_database}"  # its reconciler would tidy up in other tests' catalogs
        connection.execute(f"CREATE DATABASE {database}")
    settings = Settings(
        data_dir=data,
        database_url=postgres.get_uri(database=database),
        objects_url=f"s3://{minio}/l3ps-{secrets.token_hex(4)}?secure=0",
        redis_url=f"{redis.removesuffix('/0')}/{redis_database}",  # its worker takes every message, other tests' too
        port=free_port(),
        token=secrets.token_urlsafe(32),
    )
    env = os.environ | TUNING | {"L3PS_TRAINING": "1"}
    for name in ("data_dir", "database_url", "objects_url", "redis_url", "port"):
        env[f"L3PS_{name.upper()}"] = str(getattr(settings, name))
    env["L3PS_TOKEN"] = settings.token.get_secret_value()
    upgrade(settings.catalog_url)
    with Processes(data / "logs") as processes:
        processes.start("api", [sys.executable, "-m", "l3ps_api"], env)
        worker = [sys.executable, "-m", *WORKER, "-Q", f"{QUEUES},{TRAINER_QUEUES}", "-c", "1"]
        processes.start("worker", worker, env, stop_plan=STOP_WORKER)
        processes.wait_until(lambda: _ready(settings.api_url), "the API", 60)
        yield settings


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz").is_success
    except httpx.TransportError:
        return False


@contextmanager
def _looked_into(settings: Settings) -> Iterator[Service]:
    catalog = Catalog(settings.catalog_url).scoped(DEFAULT_PROJECT)
    credentials = {"Authorization": f"Bearer {settings.token.get_secret_value()}"}
    with httpx.Client(base_url=settings.api_url, headers=credentials, timeout=30) as http:
        yield Service(http, catalog, open_store(settings), settings)
    catalog.dispose()


@pytest.fixture
def replica(service) -> Iterator[TestClient]:
    """Another API process' app on the same catalog, which believes for long what it has read about a key."""
    api = create_app(service.settings.model_copy(update={"key_cache_seconds": 3600.0}))
    credentials = {"Authorization": f"Bearer {service.token}"}
    yield TestClient(api, base_url="http://127.0.0.1", headers=credentials)
    api.state.services.catalog.dispose()
    api.state.beside.dispose()
    api.state.services.queue.close()


@pytest.fixture(scope="session")
def command(service):
    """Runs a command of the CLI against the service; returns (exit code, standard output, standard error)."""

    def run(*words) -> tuple[int, str, str]:
        env = {"L3PS_URL": service.url, "L3PS_TOKEN": service.token}
        result = CliRunner().invoke(app, [str(word) for word in words], env=env)
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.stdout, result.stderr

    return run


@pytest.fixture(scope="session")
def drive_log(tmp_path_factory) -> Path:
    """A small simulated drive: one scene of three scans."""
    from l3ps.simulate import simulate_drive

    folder = tmp_path_factory.mktemp("log") / "street"
    simulate_drive(folder, scenes=1, scans=3, seed=5, width=320)
    return folder


@pytest.fixture(scope="session")
def bundle(tmp_path_factory) -> Path:
    """A model bundle that takes bright pixels for cars, green ones for vegetation and the rest for road."""
    folder = tmp_path_factory.mktemp("bundle") / "colours"
    folder.mkdir()
    height, width = 96, 160
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, height, width])
    weights = numpy_helper.from_array(np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1), "w")
    graph = helper.make_graph([helper.make_node("Conv", ["image", "w"], ["logits"])], "g", [image], [logits], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    (folder / "model.onnx").write_bytes(model.SerializeToString())
    classes = {"car": 4, "vegetation": 16, "road": 11}
    description = {
        "name": "colours",
        "input": {"name": "image", "height": height, "width": width},
        "output": {"semantic": "logits"},
        "classes": list(classes),
        "to_nuscenes": classes,
    }
    (folder / "model.json").write_text(json.dumps(description))
    return folder


@pytest.fixture(scope="session")
def observed(service, drive_log, bundle, tmp_path_factory) -> dict:
    """A job that was looked after: its document once it succeeded, with the id of the request that made it."""
    folder = tmp_path_factory.mktemp("observed")
    pack_log(drive_log, folder / "log.tar")
    pack_bundle(bundle, folder / "model.zip")
    model = service.upload((folder / "model.zip").read_bytes(), "model.zip", "model", name="observed").json()
    drive = service.upload((folder / "log.tar").read_bytes() + bytes(512), "log.tar").json()
    service.wait(f"/v1/models/{model['id']}", lambda document: document["state"] == "ready")
    request = {"drive_id": drive["id"], "model": "observed", "preset": "fast"}
    answer = service.http.post("/v1/jobs", json=request, headers={"X-Request-Id": "test-4711"})
    job = service.wait_for_job(answer.json()["id"])
    assert job["state"] == "succeeded", job
    return job | {"request": answer.headers["x-request-id"]}


@pytest.fixture(scope="session")
def api_process(tmp_path_factory) -> Iterator:
    """Starts an API of its own, without a worker; called with settings, returns its URL once it answers at all."""
    folder = tmp_path_factory.mktemp("api")
    with Processes(folder / "logs") as processes:

        def start(**settings: str) -> str:
            port = free_port()
            settings = {"data_dir": str(folder / str(port)), "port": str(port)} | settings
            env = os.environ | {f"L3PS_{name.upper()}": value for name, value in settings.items()}
            processes.start(f"api-{port}", [sys.executable, "-m", "l3ps_api"], env)
            url = f"http://127.0.0.1:{port}"
            processes.wait_until(lambda: _alive(url), "the API", 60)
            return url

        yield start


def _alive(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").is_success
    except httpx.TransportError:
        return False


class Played:
    """A job whose worker the test plays, on a drive and a model that exist in the catalog alone."""

    def __init__(self, catalog: Catalog, scenes: int = 1) -> None:
        self.catalog = catalog
        file = {"filename": "f.zip", "size": 9, "object_key": None}
        with catalog.transaction() as tx:
            drive = drives.add(tx, name="played", **file)
            drive.state = DriveState.READY
            named = [{"name": f"scene-{n}", "scans": 1, "points": 5} for n in range(scenes)]
            drive.info = {"scenes": named, "scans": scenes, "points": 5 * scenes, "has_truth": False}
            model = bundles.add(tx, name=f"played-{secrets.token_hex(4)}", **file)
            model.state, model.info = ModelState.READY, {}
            tx.session.flush()
            self.id = workflow.submit_job(tx, drive_id=drive.id, model=model.id).id

    def take(self) -> workflow.Claim:
        """Claim the next stage that waits for a worker."""
        with self.catalog.transaction() as tx:
            stage = next(row for row in stages.of_job(tx.session, self.id) if row.state is StageState.QUEUED)
            claim = workflow.claim(tx, stage.id, stage.attempt, "test", lease_seconds=600)
        assert claim is not None
        return claim

    def report(self, claim: workflow.Claim, step: str, done: int, total: int) -> None:
        """Tell of progress."""
        with self.catalog.transaction() as tx:
            workflow.report(tx, claim, step, done, total, fraction=done / total)

    def complete(self, claim: workflow.Claim) -> None:
        """Finish a stage."""
        with self.catalog.transaction() as tx:
            workflow.complete(tx, claim, workflow.Cost(1.0), output_key="stages/none")

    def finish(self) -> None:
        """Finish the job."""
        with self.catalog.reading() as session:
            left = sum(not row.state.final for row in stages.of_job(session, self.id))
        for _ in range(left):
            self.complete(self.take())

    def cancel(self) -> None:
        """Cancel the job."""
        with self.catalog.transaction() as tx:
            workflow.cancel_job(tx, self.id)


@pytest.fixture
def played(service) -> Iterator[Callable[..., Played]]:
    """Makes a job that the test plays the worker of; what is left of it is cancelled."""
    made: list[Played] = []

    def make(scenes: int = 1) -> Played:
        made.append(Played(service.catalog, scenes))
        return made[-1]

    yield make
    for job in made:
        job.cancel()
