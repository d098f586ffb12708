"""Deaths at chosen points: right before and right after the n-th commit, put or message of a process' life.

A point has a name: whose life it is (a stage's task, the worker's main process, the API's requests, its reconciler, its
deliverer), what is done (a commit to the catalog, a put to the store, messages to the queue), the how-manieth of that
life, and the side. Whoever comes to a point first dies there by SIGKILL and leaves a file of that name; who comes later
goes on. So a service under load visits all there are, each once.

``CHAOS_POINTS`` is a JSON object: how many of each to die at, by life; ``*`` stands for every task.
"""

import json
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from sqlalchemy import event

from l3ps_platform.catalog import session
from l3ps_platform.objects.directory import DirectoryStore
from l3ps_platform.objects.s3 import S3Store
from l3ps_platform.queue import Queue

FOLDER = Path(os.environ["CHAOS_FOLDER"]) / "points"
LIMITS: dict[str, int] = json.loads(os.environ.get("CHAOS_POINTS", "{}"))
MOST_OF_ONE = 3
"""Deaths of one and the same task: its waits double each time, and others come by the same points."""

_lock = threading.Lock()
_counts: Counter[tuple[str, str]] = Counter()
_task: tuple[str, str] | None = None


def _life() -> str | None:
    return None  # until somebody says


def live(life: Callable[[], str | None]) -> None:
    """Say how to tell whose life it is that comes to a point; None for nobody's."""
    global _life  # noqa: PLW0603
    _life = life


def begin(stage: str | None = None, id: str = "") -> None:
    """A task begins, or none is at work any more: count anew."""
    global _task  # noqa: PLW0603
    with _lock:
        _counts.clear()
        _task = (stage, id) if stage is not None else None


def task() -> str | None:
    """The stage that is at work in this process."""
    return _task[0] if _task is not None else None


def pass_by(what: str, side: str) -> None:
    """Die here if nobody has."""
    life = _life()
    if life is None:
        return
    with _lock:
        _counts[life, what] += side == "before"
        count = _counts[life, what]
    if count > LIMITS.get(life, LIMITS.get("*", 0) if life == task() else 0):
        return
    point = FOLDER / f"{life}.{what}.{count}.{side}"
    if point.exists() or (_task is not None and len(list(FOLDER.glob(f"of.{_task[1]}.*"))) >= MOST_OF_ONE):
        return
    try:
        point.touch(exist_ok=False)
    except FileExistsError:
        return
    if _task is not None:
        (FOLDER / f"of.{_task[1]}.{point.name}").touch()
    os.kill(os.getpid(), signal.SIGKILL)


def _around(what: str, act: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(act)
    def acted(*args: Any, **options: Any) -> Any:
        pass_by(what, "before")
        done = act(*args, **options)
        pass_by(what, "after")
        return done

    return acted


def arm() -> None:
    """Watch this process and all that it forks."""
    if not LIMITS:
        return
    FOLDER.mkdir(exist_ok=True)
    event.listen(session._CatalogSession, "before_commit", lambda _: pass_by("commit", "before"))
    event.listen(session._CatalogSession, "after_commit", lambda _: pass_by("commit", "after"))
    for store in (S3Store, DirectoryStore):
        for name in ("put_file", "put_bytes"):
            setattr(store, name, _around("put", getattr(store, name)))
    Queue.send = _around("message", Queue.send)  # type: ignore[method-assign]
