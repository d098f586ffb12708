"""What the directory store needs of a disk: whole files or none, fast copies, its errors in the project's words."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from l3ps_platform.errors import StoreUnavailable, UploadError

BLOCK = 1 << 20
"""Bytes read or written at a time."""


class Incoming:
    """A body being received; written to a temporary file and hashed on the way.

    Args:
        file: where it goes.
        announced: bytes that it must have, where that is fixed.
    """

    def __init__(self, file: BinaryIO, announced: int | None = None) -> None:
        self._file = file
        self._announced = announced
        self._md5 = hashlib.md5(usedforsecurity=False)
        self.size = 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append a block. UploadError when there are more bytes than announced."""
        if self._announced is not None and self.size + len(data) > self._announced:
            raise UploadError(f"the body is longer than the {self._announced} bytes announced: send it as announced")
        write_all(self._file, data)
        self._md5.update(data)
        self.size += len(data)

    def check(self) -> None:
        """UploadError unless all that was announced is there."""
        if self._announced not in (None, self.size):
            what = f"{self.size} bytes came, {self._announced} were announced"
            raise UploadError(f"{what}: send the part in the size that was announced")

    @property
    def etag(self) -> str:
        """md5 of what came so far, as S3 names parts."""
        return self._md5.hexdigest()


@contextmanager
def half_written(folder: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """A new unbuffered file in ``folder`` to write with :func:`write_all` and then to move where it belongs.

    One that was not moved is gone afterwards.
    """
    with disk_errors():
        path = folder / secrets.token_hex(16)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with path.open("xb", buffering=0) as file:
                yield file, path
        finally:
            path.unlink(missing_ok=True)


def to_disk(file: BinaryIO) -> None:
    """Wait until what was written is on the disk."""
    file.flush()
    os.fsync(file.fileno())


def write_all(file: BinaryIO, data: bytes | bytearray | memoryview) -> None:
    """Write all of it to an unbuffered file, which by itself may take only some."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


def append(target: BinaryIO, source: BinaryIO) -> None:
    """Copy the rest of an unbuffered file to another, inside the kernel where their file systems can."""
    with suppress(OSError):  # what they cannot goes through this process
        while os.copy_file_range(source.fileno(), target.fileno(), 1 << 30):
            pass
    while block := source.read(BLOCK):
        write_all(target, block)


def vanish(folder: Path, aside: Path) -> None:
    """Delete a folder with all that is in it, at once for everybody else: nothing can be put into it meanwhile."""
    gone = aside / secrets.token_hex(16)
    aside.mkdir(parents=True, exist_ok=True)
    with suppress(FileNotFoundError):
        folder.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)


@contextmanager
def disk_errors() -> Iterator[None]:
    """Say a disk's errors in the project's own."""
    try:
        yield
    except OSError as error:
        raise StoreUnavailable(f"the object store's disk failed: {error}") from error
