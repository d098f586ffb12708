"""The worker's real application with faults in its stages: ``celery -A chaoslib.saboteur worker``.

``CHAOS_FAULTS`` is a JSON list of ``{"stage", "fault", "nth", "scene", "when", "seconds"}``. Faults happen in the
stages' processes, around the real work; which run of a stage it is, is counted over all processes by files in
``CHAOS_FOLDER``, where each run also leaves a line: what ran, and how often. A file ``disarmed`` there ends all faults.

``CHAOS_POINTS`` has processes die at points instead (:mod:`chaoslib.points`). ``CHAOS_RELEASE`` makes it another
release, whose code for every stage is another.
"""

import ctypes
import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from celery import signals

from chaoslib import points
from l3ps_platform.catalog import SceneRow, StageName
from l3ps_worker import keys, runner
from l3ps_worker.app import app

__all__ = ["app"]

FOLDER = Path(os.environ["CHAOS_FOLDER"])
FAULTS: list[dict[str, Any]] = json.loads(os.environ.get("CHAOS_FAULTS", "[]"))


def memory(fault: dict[str, Any], progress: Any) -> None:
    """A real MemoryError: the kernel refuses more than a little above what the process holds."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), before[1]))
    try:
        bytearray(1 << 30)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def abort(fault: dict[str, Any], progress: Any) -> None:
    """What compiled code does that finds its own state broken."""
    os.abort()


def slow(fault: dict[str, Any], progress: Any) -> None:
    """Work that takes long and reports."""
    until = time.monotonic() + fault["seconds"]
    while time.monotonic() < until:
        progress("segment", 0, 1)
        time.sleep(0.05)


def native(fault: dict[str, Any], progress: Any) -> None:
    """Compiled code that holds the interpreter lock and reports nothing."""
    ctypes.PyDLL(None).usleep(int(fault["seconds"] * 1e6))


KINDS: dict[str, Callable[[dict[str, Any], Any], None]] = {
    "memory": memory,
    "abort": abort,
    "slow": slow,
    "native": native,
}


def number(name: str) -> int:
    """The next number of a counter that all processes share."""
    count = 1
    while True:
        try:
            (FOLDER / f"{name}.{count}").touch(exist_ok=False)
        except FileExistsError:
            count += 1
        else:
            return count


def scene_of(context: Any, claim: Any) -> str | None:
    if claim.scene_id is None:
        return None
    with context.catalog.reading() as session:
        return str(session.get_one(SceneRow, claim.scene_id).name)


def sabotaged(name: StageName, work: Callable[..., Any]) -> Callable[..., Any]:
    def run(context: Any, claim: Any, progress: Any) -> Any:
        with (FOLDER / "runs.log").open("a") as log:
            log.write(f"{claim.stage_id} {claim.attempt}\n")
        scene = scene_of(context, claim)
        faults = [f for f in FAULTS if f["stage"] == name.value and f.get("scene") in (None, scene)]
        count = number(name.value) if faults else 0

        def act(when: str) -> None:
            for fault in faults if not (FOLDER / "disarmed").exists() else ():
                if fault.get("when", "before") == when and ("nth" not in fault or count in fault["nth"]):
                    KINDS[fault["fault"]](fault, progress)

        act("before")
        done = work(context, claim, progress)
        act("after")
        return done

    return run


for _name, (_work, _steps) in list(runner.WORK.items()):
    runner.WORK[_name] = (sabotaged(_name, _work), _steps)


_main_pid = os.getpid()


def whose_life() -> str | None:
    """The main process' own, or that of the task at work in a child."""
    return "main" if os.getpid() == _main_pid else points.task()


@signals.task_prerun.connect
def _begin(sender: Any = None, args: Any = (), **_: Any) -> None:
    points.begin(sender.name.removeprefix("l3ps."), args[0])


@signals.task_postrun.connect
def _end(**_: Any) -> None:
    points.begin()


points.live(whose_life)
points.arm()


def release(name: str) -> None:
    """Have every digest of the code say that this is another release."""
    code = keys.code_version
    keys.code_version = lambda parts=(): f"{name}-{code(parts)}"  # type: ignore[assignment]


if os.environ.get("CHAOS_RELEASE"):
    release(os.environ["CHAOS_RELEASE"])
