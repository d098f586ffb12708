"""An API that is killed at each step of an upload in turn: the upload always arrives, once, and nothing else stays."""

import itertools
import os
import random
import secrets
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from l3ps_cli.stack import free_port
from l3ps_client import Client, Retry, Unreachable
from l3ps_platform.catalog import Catalog
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.objects import DirectoryStore, open_store
from l3ps_platform.settings import Settings
from l3ps_platform.workflow import Sweeper

MORTAL = Path(__file__).with_name("mortal_api.py")
IMPATIENT = Retry(tries=1, first=0.0)
"""Whoever loses an answer gives up, as a process that is killed itself: the next one goes on from its note."""


@contextmanager
def mortal_api(settings: Settings):
    """Runs the API; called with a number it dies at that step from then on. Tells whether it did at the one before."""
    env = os.environ | {
        "L3PS_DATA_DIR": str(settings.data_dir), "L3PS_PORT": str(settings.port),
        "L3PS_DATABASE_URL": settings.database_url, "L3PS_OBJECTS_URL": settings.objects_url,
        "L3PS_REDIS_URL": settings.redis_url, "L3PS_TOKEN": settings.token.get_secret_value(),
        "L3PS_IDEMPOTENCY_LEASE_SECONDS": "0.1",
        "L3PS_MIGRATE_ON_START": "0",
    }  # fmt: skip
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": env}
    with (settings.data_dir / "log").open("w") as log:
        process = subprocess.Popen([sys.executable, MORTAL], stderr=log, **pipes)

    def dies_at(step: int) -> bool:
        process.stdin.write(f"{step}\n")
        process.stdin.flush()
        answer = process.stdout.readline().strip()
        assert answer in ("died", "lived"), (settings.data_dir / "log").read_text()
        return answer == "died"

    with process:
        try:
            yield dies_at
        finally:
            process.stdin.close()
            process.wait(30)


@pytest.fixture(params=["embedded", "servers"])
def settings(request, tmp_path, redis_server) -> Settings:
    """SQLite and a directory, or PostgreSQL and MinIO."""
    places = {}
    if request.param == "servers":
        places = {name: request.getfixturevalue(fixture) for name, fixture in PLACES.items()}
    settings = Settings(
        data_dir=tmp_path, redis_url=redis_server.removesuffix("/0") + "/6", port=free_port(),
        token=secrets.token_urlsafe(32), **places,
    )  # fmt: skip
    upgrade(settings.catalog_url)
    return settings


PLACES = {"database_url": "postgres_url", "objects_url": "s3_url"}


@pytest.mark.services
def test_an_upload_arrives_once_whenever_the_api_is_killed(settings, tmp_path):
    file = tmp_path / "morning.tar"
    file.write_bytes(bytes(257) + b"ustar" + random.Random(1).randbytes(100_000))
    store, token = open_store(settings), settings.token.get_secret_value()
    with mortal_api(settings) as dies_at, Client(settings.api_url, token) as client:
        dies_at(0)
        client.me()  # it is up
        for step in itertools.count(1):
            dies_at(step)
            drive, tries = send(settings, file, f"step {step}", tmp_path / "notes")
            died = dies_at(0)
            assert tries <= 2, f"killed once, at step {step}, it took {tries} calls"
            assert (drive["name"], drive["size"]) == (f"step {step}", file.stat().st_size)
            if not died:
                break
        assert step > 15, "it was killed at every step of an upload"
        names = sorted(drive["name"] for drive in client.drives.list())
        assert names == sorted(f"step {n}" for n in range(1, step + 1))
        assert list(client.uploads.list(state="open")) == []
    assert list((tmp_path / "notes").iterdir()) == []

    swept = settings.model_copy(update={"orphan_seconds": 0.0, "upload_ttl_seconds": 0})
    catalog = Catalog(settings.catalog_url)
    Sweeper(catalog, store, swept).run_once()
    catalog.dispose()
    assert len(list(store.list("uploads/"))) == step
    assert all(store.get_bytes(info.key) == file.read_bytes() for info in store.list("uploads/"))
    assert list(store.list_multipart()) == []
    if isinstance(store, DirectoryStore):
        assert [*(store.root / "tmp").iterdir(), *(store.root / "multipart").iterdir()] == []


def send(settings: Settings, file: Path, name: str, notes: Path) -> tuple[dict, int]:
    """Send a file by one process after the other until one comes through; the drive, and how many it took."""
    for tries in itertools.count(1):
        token = settings.token.get_secret_value()
        with Client(settings.api_url, token, retry=IMPATIENT, state=notes) as client:
            try:
                return client.drives.upload(file, name=name, parallel=1), tries
            except Unreachable:
                continue
    raise AssertionError
