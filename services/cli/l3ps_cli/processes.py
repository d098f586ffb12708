"""Child processes that never outlive their parent.

Each child leads a process group of its own, so that Ctrl-C in a terminal reaches the parent alone, which then stops
the children in order, and so that whatever a child forked goes with it. Should the parent be killed outright, Linux
kills the children (``PR_SET_PDEATHSIG``).
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

_PR_SET_PDEATHSIG = 1
_POLL_SECONDS = 0.02

StopPlan = tuple[tuple[signal.Signals, float], ...]
"""Signals to send in turn, each with the seconds to wait for the child to leave; SIGKILL follows the last."""

GENTLY: StopPlan = ((signal.SIGTERM, 5.0),)


class ChildDiedError(Exception):
    """A child ended that should have stayed."""

    def __init__(self, child: Child) -> None:
        self.child = child
        super().__init__(f"{child.name} stopped by itself ({child.ending}); its log is {child.log}")


@dataclass
class Child:
    """One running child.

    Attributes:
        name: what it is called in messages and in its log's name.
        pid: process id, which is also the id of its process group.
        log: the file that takes its standard output and error.
        stop_plan: how to ask it to leave.
        returncode: exit status once it has ended, negative for a signal, None while it runs.
    """

    name: str
    pid: int
    log: Path
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

    def last_lines(self, count: int = 8) -> str:
        """The end of its log, for an error message."""
        with suppress(OSError):
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-count:])
        return ""

    def _gone_within(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while self.running():
            if time.monotonic() > deadline:
                return False
            time.sleep(_POLL_SECONDS)
        return True


class Processes:
    """The children of one parent: started in order, stopped in the reverse order.

    Use as a context manager and start children from the main thread: Linux takes the end of the *thread* that
    forked for the parent's death.
    """

    def __init__(self, logs: Path) -> None:
        self.logs = logs
        self.children: list[Child] = []

    def __enter__(self) -> Processes:
        self.logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(
        self,
        name: str,
        argv: Sequence[str | Path],
        env: Mapping[str, str],
        *,
        cwd: Path | None = None,
        stop_plan: StopPlan = GENTLY,
    ) -> Child:
        """Start a child whose output goes to ``logs/NAME.log``.

        Args:
            name: the child's name.
            argv: program and arguments; no shell is involved.
            env: the child's whole environment.
            cwd: working directory.
            stop_plan: how to ask it to leave.
        """
        log = self.logs / f"{name}.log"
        with log.open("ab") as output:
            popen = subprocess.Popen(
                [str(word) for word in argv],
                env=dict(env),
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent(os.getpid()),  # noqa: PLW1509  (two system calls, no locks, no allocation)
            )
        popen.returncode = 0  # this class reaps; Popen must not, nor warn that it did not
        child = Child(name=name, pid=popen.pid, log=log, stop_plan=stop_plan)
        self.children.append(child)
        return child

    def check(self) -> None:
        """Raise ChildDiedError when a child has ended."""
        for child in self.children:
            if not child.running():
                raise ChildDiedError(child)

    def wait_until(self, ready: Callable[[], bool], what: str, seconds: float) -> None:
        """Poll until ``ready()``; ChildDiedError when a child ends meanwhile, TimeoutError after ``seconds``."""
        deadline = time.monotonic() + seconds
        while not ready():
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} was not ready within {seconds:.0f} seconds; the logs are in {self.logs}")
            time.sleep(5 * _POLL_SECONDS)

    def stop(self) -> None:
        """Stop every child, the last started first."""
        for child in reversed(self.children):
            child.stop()


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
