"""The worker's disk: unpacked drives and models by checksum, and folders for work in progress.

    SCRATCH/cache/<key>/log      an unpacked drive or a model; the key is what it is and its sha256
    SCRATCH/locks/<key>          shared while in use, exclusive while being made or deleted
    SCRATCH/work/<random>/       what a stage is writing; its lock tells the living from the dead
    SCRATCH/locks/worker-<name>  held by a worker for as long as it lives

Processes agree by ``flock``, which the kernel gives back however a process ends.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import structlog

from l3ps_platform.workflow import disk_is_full

log = structlog.get_logger(__name__)


class Scratch:
    """A size-bounded cache and a place to work.

    Args:
        root: the directory.
        budget: bytes the cache may hold; entries in use stay even beyond it.
    """

    def __init__(self, root: Path, budget: int) -> None:
        self._cache = root / "cache"
        self._locks = root / "locks"
        self._work = root / "work"
        self._budget = budget
        for folder in (self._cache, self._locks, self._work):
            folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def entry(self, key: str, make: Callable[[Path], object]) -> Iterator[Path]:
        """A cached file or folder, in use until the block ends.

        Args:
            key: names the content; equal keys are equal content.
            make: fills a path that does not exist yet, when nobody has; called by one process at a time.
        """
        with (self._locks / key).open("a+b") as lock:
            content = self._cache / key / "log"
            fcntl.flock(lock, fcntl.LOCK_SH)
            while not content.exists():
                fcntl.flock(lock, fcntl.LOCK_EX)  # lets go of the shared lock first, so look again
                if not content.exists():
                    self._make(key, make)
                fcntl.flock(lock, fcntl.LOCK_SH)  # may let an eviction in between, so look again
            os.utime(content.parent)
            yield content

    def free(self) -> None:
        """Delete every entry that is not in use, and what dead processes left."""
        self._evict(0)
        self.sweep()

    def drop(self, key: str) -> None:
        """Delete an entry unless it is in use."""
        with (self._locks / key).open("a+b") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return
            shutil.rmtree(self._cache / key, ignore_errors=True)

    @contextmanager
    def workdir(self) -> Iterator[Path]:
        """An empty folder that is gone after the block; those of dead processes are swept on the way."""
        self.sweep()
        folder = self._work / secrets.token_hex(8)
        lock_path = self._locks / f"work-{folder.name}"
        with self._own(lock_path):
            folder.mkdir()
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                lock_path.unlink(missing_ok=True)

    def sweep(self) -> None:
        """Delete the work folders of dead processes."""
        for name in self._abandoned("work-"):
            shutil.rmtree(self._work / name, ignore_errors=True)

    @contextmanager
    def alive(self, worker: str) -> Iterator[None]:
        """While the block runs, and in what was forked in it, the worker of this name counts as alive."""
        with self._own(self._locks / f"worker-{worker}"):
            yield

    def dead_workers(self) -> Iterator[str]:
        """Names of workers that are gone; each is forgotten when the caller goes on to the next."""
        return self._abandoned("worker-")

    def _abandoned(self, kind: str) -> Iterator[str]:
        """What this kind of lock is named after, where nobody holds it; it is deleted when the caller goes on."""
        for lock_path in self._locks.glob(f"{kind}*"):
            try:
                with lock_path.open("r+b") as lock:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    yield lock_path.name.removeprefix(kind)
                    lock_path.unlink(missing_ok=True)
            except (BlockingIOError, FileNotFoundError):
                continue

    @contextmanager
    def _own(self, lock_path: Path) -> Iterator[None]:
        """Hold a lock of this process' own; a sweep that came between its making and its locking took it away."""
        while True:
            with lock_path.open("a+b") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                mine = False
                with suppress(FileNotFoundError):
                    mine = lock_path.stat().st_ino == os.fstat(lock.fileno()).st_ino
                if mine:
                    yield
                    return

    def _make(self, key: str, make: Callable[[Path], object]) -> None:
        """Make an entry; on a full disk once more with every entry deleted that nobody uses."""
        self._evict(self._budget)
        try:
            self._fill(key, make)
        except Exception as error:
            if not disk_is_full(error):
                raise
            log.warning("scratch is full, deleting what is not in use", key=key)
            self.free()
            self._fill(key, make)

    def _fill(self, key: str, make: Callable[[Path], object]) -> None:
        entry = self._cache / key
        shutil.rmtree(entry, ignore_errors=True)  # half of one that a killed process began
        entry.mkdir()
        try:
            make(entry / "new")
            (entry / "size").write_text(str(_size(entry / "new")))
            (entry / "new").rename(entry / "log")
        except BaseException:
            shutil.rmtree(entry, ignore_errors=True)
            raise

    def _evict(self, budget: int) -> None:
        """Delete entries, the longest unused first, until the cache is within a budget, in bytes."""
        entries = []
        for entry in self._cache.iterdir():
            try:
                entries.append((entry.stat().st_mtime, int((entry / "size").read_text()), entry.name))
            except (OSError, ValueError):
                self.drop(entry.name)  # half of one that a killed process began; one being made is in use
        held = sum(size for _, size, _ in entries)
        for _, size, key in sorted(entries):
            if held <= budget:
                return
            self.drop(key)
            if not (self._cache / key).exists():
                held -= size
                log.info("scratch entry evicted", key=key, bytes=size)


def _size(path: Path) -> int:
    if path.is_file():
        return path.stat().st_size
    return sum((Path(folder) / name).lstat().st_size for folder, _, names in os.walk(path) for name in names)
