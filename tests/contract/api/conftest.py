"""The real API in a real process, with everything it stands on, and eyes into its catalog and store."""

import os
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import httpx
import pytest

from l3ps_cli.processes import Processes
from l3ps_cli.stack import STOP_WORKER, Stack, StackOptions, free_port
from l3ps_platform.catalog import Catalog
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.settings import Settings

MiB = 1 << 20
TUNING = {"L3PS_PART_BYTES": str(5 * MiB), "L3PS_MAX_MODEL_BYTES": str(8 * MiB), "L3PS_RECONCILE_SECONDS": "0.5"}


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
        for error in document["errors"]:
            assert error["where"] and error["what"] and error["remedy"]
        return document


@pytest.fixture(scope="session", params=["embedded", "servers"])
def service(request, tmp_path_factory) -> Iterator[Service]:
    """The service twice: as ``l3ps up`` runs it, and on PostgreSQL, MinIO and a Redis server."""
    data = tmp_path_factory.mktemp("service")
    start = _embedded if request.param == "embedded" else _servers
    with start(request, data) as settings, _looked_into(settings) as service:
        yield service


@contextmanager
def _embedded(request, data) -> Iterator[Settings]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in TUNING.items():
            patch.setenv(name, value)
        with Stack(StackOptions(data, port=0)) as stack:
            yield Settings(data_dir=data, port=int(stack.url.rpartition(":")[2]))


@contextmanager
def _servers(request, data) -> Iterator[Settings]:
    postgres, minio, redis = map(request.getfixturevalue, ("postgres_server", "minio_server", "redis_server"))
    settings = Settings(
        data_dir=data,
        database_url=postgres.get_uri(),
        objects_url=f"s3://{minio}/l3ps-{secrets.token_hex(4)}?secure=0",
        redis_url=redis,
        port=free_port(),
    )
    env = os.environ | TUNING
    for name in ("data_dir", "database_url", "objects_url", "redis_url", "port"):
        env[f"L3PS_{name.upper()}"] = str(getattr(settings, name))
    upgrade(settings.catalog_url)
    with Processes(data / "logs") as processes:
        processes.start("api", [sys.executable, "-m", "l3ps_api"], env)
        worker = [sys.executable, "-m", "celery", "-A", "l3ps_worker.app", "worker", "-Q", "segment,refine", "-c", "1"]
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
    catalog = Catalog(settings.catalog_url)
    with httpx.Client(base_url=settings.api_url, timeout=30) as http:
        yield Service(http, catalog, open_store(settings), settings)
    catalog.dispose()


@pytest.fixture(scope="module")
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
