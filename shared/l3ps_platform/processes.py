"""Child processes that never outlive their parent, and what the kernel knows of processes.

A child leads a process group of its own, so that Ctrl-C in a terminal reaches the parent alone, which then stops its
children in order, and so that whatever a child forked goes with it. Should the parent be killed outright, Linux kills
the children (``PR_SET_PDEATHSIG``).
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

_PR_SET_PDEATHSIG = 1
_POLL_SECONDS = 0.02

StopPlan = tuple[tuple[signal.Signals, float], ...]
"""Signals to send in turn, each with the seconds to wait for the child to leave; SIGKILL follows the last."""

GENTLY: StopPlan = ((signal.SIGTERM, 5.0),)


@dataclass
class Child:
    """One running child.

    Attributes:
        name: what it is called in messages and in its log's name.
        pid: process id, which is also the id of its process group.
        stop_plan: how to ask it to leave.
        returncode: exit status once it has ended, negative for a signal, None while it runs.
    """

    name: str
    pid: int
    stop_plan: StopPlan = GENTLY
    returncode: int | None = field(default=None)

    @property
    def ending(self) -> str:
        """How it ended, in words."""
        if self.returncode is None:
            return "still running"
        if self.returncode < 0:
            return f"killed by {signal.Signals(-self.returncode).name}"
        return f"exit status {self.returncode}"

    def running(self) -> bool:
        """Whether it still runs. On its end the rest of its group is killed and the child reaped."""
        if self.returncode is not None:
            return False
        # WNOWAIT leaves the zombie, and with it the group's id, in place: no stranger can own it in the kill below.
        if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
            return True
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        _, status = os.waitpid(self.pid, 0)
        self.returncode = os.waitstatus_to_exitcode(status)
        return False

    def stop(self) -> None:
        """Ask it to leave by its stop plan, then kill its whole group."""
        for request, seconds in self.stop_plan:
            if not self.running():
                return
            os.kill(self.pid, request)
            if self._gone_within(seconds):
                return
        while self.running():
            os.killpg(self.pid, signal.SIGKILL)
            self._gone_within(1.0)

    def _gone_within(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while self.running():
            if time.monotonic() > deadline:
                return False
            time.sleep(_POLL_SECONDS)
        return True


def spawn(
    name: str,
    argv: Sequence[str | Path],
    env: Mapping[str, str],
    *,
    stdout: int | IO[bytes],
    stderr: int | IO[bytes],
    cwd: Path | None = None,
    stop_plan: StopPlan = GENTLY,
) -> Child:
    """Start a child. To be called from a thread that lasts: Linux takes the end of the *thread* for the parent's.

    Args:
        name: what messages call it.
        argv: program and arguments; no shell is involved.
        env: the child's whole environment.
        stdout, stderr: where its output goes, as :class:`subprocess.Popen` takes it; no pipe for it to make.
        cwd: working directory.
        stop_plan: how to ask it to leave.
    """
    popen = subprocess.Popen(
        [str(word) for word in argv],
        env=dict(env),
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        start_new_session=True,
        preexec_fn=_die_with_parent(os.getpid()),  # noqa: PLW1509  (two system calls, no locks, no allocation)
    )
    popen.returncode = 0  # Child reaps; Popen must not, nor warn that it did not
    return Child(name, popen.pid, stop_plan)


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent is gone, however it went (Linux)."""
    arm = _die_with_parent(parent)
    if arm is not None:
        arm()


def is_child(pid: int, parent: int) -> bool:
    """Whether a process runs and is a child of ``parent``: a number that the kernel gave to another does not count."""
    try:
        state, ppid = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except (FileNotFoundError, ProcessLookupError):
        return sys.platform != "linux" and _exists(pid)
    return state not in ("Z", "X") and int(ppid) == parent


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True


def _die_with_parent(parent: int) -> Callable[[], None] | None:
    """What a child runs between fork and exec so that the kernel kills it when ``parent`` dies; None off Linux."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl  # resolved before the fork: the child must not load anything

    def arm() -> None:
        prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:  # the parent died before the request took effect
            os._exit(1)

    return arm
