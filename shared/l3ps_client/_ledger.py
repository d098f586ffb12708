"""Notes of unfinished uploads: one small file each, so that the next process goes on where this one was killed.

A note holds no URL and no token: a presigned URL is a credential, and the service hands out fresh ones.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

if sys.platform != "win32":
    import fcntl

_KEEP_SECONDS = 30 * 24 * 3600
"""Services forget an open upload after a day, or as configured; a note older than this is of no use to anybody."""


class Note:
    """What is known of one upload.

    Attributes:
        facts: survive the process once saved.
        lasting: whether they do; False where the folder cannot be written or another process has this upload in hand.
    """

    def __init__(self, facts: dict[str, Any], file: IO[str] | None) -> None:
        self.facts, self._file = facts, file

    @property
    def lasting(self) -> bool:
        return self._file is not None

    def save(self, **facts: Any) -> None:
        """Add facts and put them on the disk."""
        self.facts |= facts
        self._write(json.dumps(self.facts))

    def forget(self) -> None:
        """The upload is over."""
        self.facts = {}
        self._write("")

    def _write(self, text: str) -> None:
        if self._file is not None:
            self._file.seek(0)
            self._file.truncate()
            self._file.write(text)
            self._file.flush()
            os.fsync(self._file.fileno())


class Ledger:
    """The folder of notes; None keeps none."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    @contextmanager
    def note(self, **identity: Any) -> Iterator[Note]:
        """The note of the upload that these facts identify, held by this process alone."""
        name = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]
        file = self._open(name)
        note = Note(_read(file) if file else {}, file)
        try:
            yield note
        finally:
            if file is not None and self.folder is not None:
                if not note.facts:
                    _delete(self.folder / f"{name}.json", file)
                file.close()

    def of_file(self, path: Path) -> list[dict[str, Any]]:
        """Facts of the unfinished uploads of a file."""
        wanted = str(path.resolve())
        return [facts for facts in self._all() if facts.get("path") == wanted]

    def _all(self) -> Iterator[dict[str, Any]]:
        for path in sorted(self.folder.glob("*.json")) if self.folder else []:
            with suppress(OSError, ValueError):
                facts = json.loads(path.read_text())
                if isinstance(facts, dict):
                    yield facts

    def _open(self, name: str) -> IO[str] | None:
        """The note's file, locked; None where there can be none."""
        if self.folder is None:
            return None
        path = self.folder / f"{name}.json"
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._drop_old()
            while True:
                file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+")
                if _lock(file, path):
                    return file
                file.close()
        except OSError:
            return None

    def _drop_old(self) -> None:
        assert self.folder is not None
        for path in self.folder.glob("*.json"):
            with suppress(OSError):
                if path.stat().st_mtime < time.time() - _KEEP_SECONDS:
                    path.unlink()


def _lock(file: IO[str], path: Path) -> bool:
    """Take a note for this process. OSError where another has it; False where that one has just deleted it."""
    if sys.platform == "win32":  # there two processes with the same file would share its upload
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
    except OSError:
        file.close()
        raise


def _delete(path: Path, file: IO[str]) -> None:
    """Delete a note: while it is locked, so that nobody else holds it; Windows deletes no file that is open."""
    if sys.platform == "win32":
        file.close()
    path.unlink(missing_ok=True)


def _read(file: IO[str]) -> dict[str, Any]:
    try:
        facts = json.load(file)
    except ValueError:
        return {}
    return facts if isinstance(facts, dict) else {}
