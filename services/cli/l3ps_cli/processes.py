"""The children of the embedded stack: each with a log file, started in order, stopped in the reverse order."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from l3ps_platform.processes import GENTLY, Child, StopPlan, spawn

_POLL_SECONDS = 0.1


class ChildDiedError(Exception):
    """A child ended that should have stayed.

    Attributes:
        last_lines: the end of its log, for an error message.
    """

    def __init__(self, child: Child, log: Path, lines: int = 8) -> None:
        self.last_lines = ""
        with suppress(OSError):
            self.last_lines = "\n".join(log.read_text(errors="replace").splitlines()[-lines:])
        super().__init__(f"{child.name} stopped by itself ({child.ending}); its log is {log}")


class Processes:
    """The children of one parent: started in order, stopped in the reverse order.

    Use as a context manager and start children from the main thread (see :func:`l3ps_platform.processes.spawn`).
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
        with self.log_of(name).open("ab") as output:
            child = spawn(name, argv, env, stdout=output, stderr=subprocess.STDOUT, cwd=cwd, stop_plan=stop_plan)
        self.children.append(child)
        return child

    def log_of(self, name: str) -> Path:
        """The file that takes a child's standard output and error."""
        return self.logs / f"{name}.log"

    def check(self) -> None:
        """Raise ChildDiedError when a child has ended."""
        for child in self.children:
            if not child.running():
                raise ChildDiedError(child, self.log_of(child.name))

    def wait_until(self, ready: Callable[[], bool], what: str, seconds: float) -> None:
        """Poll until ``ready()``; ChildDiedError when a child ends meanwhile, TimeoutError after ``seconds``."""
        deadline = time.monotonic() + seconds
        while not ready():
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} was not ready within {seconds:.0f} seconds; the logs are in {self.logs}")
            time.sleep(_POLL_SECONDS)

    def stop(self) -> None:
        """Stop every child, the last started first."""
        for child in reversed(self.children):
            child.stop()
