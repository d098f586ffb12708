"""The trainer as a child process: it writes events to standard output and its log to standard error.

torch never comes into a worker's own process: the trainer is started by its name, may be killed for memory without
the worker, and gives back all it took when it ends.
"""

from __future__ import annotations

import json
import os
import resource
import selectors
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import structlog

from l3ps.errors import L3psError
from l3ps_platform.processes import Child, spawn

log = structlog.get_logger(__name__)

TRAINER = "l3ps_trainer"
LOG_BYTES = 256 << 10
"""How much of a log is kept, from its end."""
_LINE_BYTES = 4 << 20
"""Longer lines are no events: the longest, a report with its classes, has some ten thousand bytes."""
_TICK_SECONDS = 0.2
LEAVE_SECONDS = 15.0
"""For finishing a step of the training and writing a checkpoint; a step over ViT-L takes seconds on a CPU."""

Event = dict[str, Any]


class TrainerLost(L3psError):  # noqa: N818  (what the machine did to it, not what it found)
    """The trainer ended without a word on why; another try goes on from its last checkpoint."""


class Log:
    """The end of what the trainer said, over all its attempts."""

    def __init__(self, text: bytes = b"") -> None:
        self._text = bytearray(text)
        self.changed = False

    def write(self, data: bytes) -> None:
        """Add to it; what is too much goes from the beginning, in whole lines."""
        self._text += data
        self.changed = self.changed or bool(data)
        if len(self._text) > LOG_BYTES:
            del self._text[: len(self._text) - LOG_BYTES]
            del self._text[: self._text.find(b"\n") + 1]

    def bytes(self) -> bytes:
        """All that is kept of it."""
        return bytes(self._text)

    def last_line(self) -> str:
        """Its last line that says something, for a message."""
        lines = self._text.decode(errors="replace").split("\n")
        return next((line.strip()[:300] for line in reversed(lines) if line.strip()), "")


class Trainer:
    """A running trainer.

    Args:
        child: the process.
        events, log: the reading ends of the pipes it writes to.
        kept: takes its log.
    """

    def __init__(self, child: Child, events: IO[bytes], log: IO[bytes], kept: Log) -> None:
        self.child = child
        self._kept = kept
        self._line, self._said = bytearray(), bytearray()
        self._selector = selectors.DefaultSelector()
        for source, take in ((events, self._take_events), (log, self._take_log)):
            os.set_blocking(source.fileno(), False)
            self._selector.register(source, selectors.EVENT_READ, take)

    def events(self) -> Iterator[Event | None]:
        """Its events until it has ended, and a None now and then while there is none."""
        while self.child.running():
            yield from self._read(_TICK_SECONDS)
            yield None
        yield from self._rest()

    def stop(self, seconds: float | None = None) -> None:
        """Have it write a checkpoint and leave, and kill its whole process group if it does not in time."""
        deadline = time.monotonic() + (LEAVE_SECONDS if seconds is None else seconds)
        if self.child.running():
            os.kill(self.child.pid, signal.SIGTERM)
        # It could not leave while it waits for somebody to read what it says.
        while self.child.running() and time.monotonic() < deadline:
            self._read(_TICK_SECONDS)
        self.child.stop()
        list(self._rest())
        self._selector.close()

    def peak_mb(self) -> float:
        """Its highest resident memory so far, in MB; 0 where that cannot be told."""
        with suppress(OSError, StopIteration):
            status = Path(f"/proc/{self.child.pid}/status").read_text().splitlines()
            return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM:"))
        return 0.0

    def _rest(self) -> Iterator[Event]:
        """What was still on its way when it ended."""
        while self._selector.get_map() and self._selector.select(0):
            yield from self._read(0)

    def _read(self, seconds: float) -> list[Event]:
        if not self._selector.get_map():
            time.sleep(seconds)
            return []
        found: list[Event] = []
        for key, _ in self._selector.select(seconds):
            data = os.read(key.fd, 1 << 16)
            if data:
                found += key.data(data)
            else:
                self._selector.unregister(key.fileobj)
        return found

    def _take_log(self, data: bytes) -> list[Event]:
        self._kept.write(data)
        self._said += data
        *lines, self._said = self._said.split(b"\n")
        for said in lines:
            log.info("trainer", line=said.decode(errors="replace")[:1000], trainer=self.child.pid)
        return []

    def _take_events(self, data: bytes) -> list[Event]:
        self._line += data
        *lines, self._line = self._line.split(b"\n")
        if len(self._line) > _LINE_BYTES:
            raise TrainerLost(f"the trainer wrote {len(self._line)} bytes that are no event")
        found = []
        for line in lines:
            try:
                event = json.loads(line)
            except ValueError:
                event = None
            if isinstance(event, dict):
                found.append(event)
            else:
                self._kept.write(bytes(line) + b"\n")
        return found


@contextmanager
def running(options: Sequence[str], folder: Path, log: Log, *, gone: type[BaseException]) -> Iterator[Trainer]:
    """Start ``l3ps_trainer`` and see to it that it has ended after the block.

    Args:
        options: its command line.
        folder: its working directory.
        log: takes its log.
        gone: an exception of this kind in the block ends it at once, without a checkpoint.
    """
    # -P: modules are never taken from the working directory, which holds a stranger's files.
    argv = [sys.executable, "-P", "-m", TRAINER, *options]
    with ExitStack() as pipes:
        read_events, write_events = _pipe(pipes)
        read_log, write_log = _pipe(pipes)
        child = spawn(
            "trainer", argv, _environment(os.environ), stdout=write_events, stderr=write_log, cwd=folder, stop_plan=()
        )
        trainer = Trainer(child, read_events, read_log, log)
        write_events.close()  # ours: the reading ends are to end with the child's
        write_log.close()
        try:
            yield trainer
        except gone:
            trainer.stop(0)
            raise
        finally:
            trainer.stop()


def children_cpu_seconds() -> float:
    """Processor time of all children of this process that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _pipe(stack: ExitStack) -> tuple[IO[bytes], IO[bytes]]:
    """A pipe's ends as files, which may be closed twice without closing what has got their number meanwhile."""
    read, write = os.pipe()
    return stack.enter_context(open(read, "rb", buffering=0)), stack.enter_context(open(write, "wb", buffering=0))


def _environment(ours: Mapping[str, str]) -> dict[str, str]:
    """The worker's without the service's settings: the trainer reads a stranger's files and needs no secrets."""
    return {name: value for name, value in ours.items() if not name.startswith("L3PS_")} | {"PYTHONUNBUFFERED": "1"}
