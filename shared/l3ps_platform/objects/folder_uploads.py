"""Multipart uploads of the directory store.

MULTIPART/<id>/key                      the object it is to become
MULTIPART/<id>/part_size                bytes of every part but the last
MULTIPART/<id>/data                     that object, growing: each part is written to its place in it
MULTIPART/<id>/00001.<md5>.<bytes>      empty; says which part lies there whole, on the disk

So joining is a rename, whatever the size: a copy of 64 GiB would take minutes, and as much again of the disk.
"""

from __future__ import annotations

import fcntl
import os
import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from l3ps_platform.errors import UploadError
from l3ps_platform.objects.files import append, disk_errors, to_disk, vanish
from l3ps_platform.objects.interface import GONE, Part, Pending

_UPLOAD_ID = re.compile(r"[0-9a-f]{32}")


class FolderUploads:
    """Uploads in folders, one each.

    Args:
        root: the folder of folders.
        aside: on the same disk, for what is half made or half deleted.
    """

    def __init__(self, root: Path, aside: Path) -> None:
        self._root = root
        self._aside = aside

    def create(self, key: str, part_size: int) -> str:
        """A new upload; its id."""
        upload_id = secrets.token_hex(16)
        with disk_errors():
            folder = self._aside / upload_id
            folder.mkdir(parents=True)
            (folder / "key").write_text(key)
            (folder / "part_size").write_text(str(part_size))
            (folder / "data").touch()
            self._root.mkdir(parents=True, exist_ok=True)
            folder.rename(self._root / upload_id)
        return upload_id

    def check(self, key: str, upload_id: str) -> Path:
        """The upload's folder. UploadError when it is not there, becomes another object or has become one."""
        folder = self._of(key, upload_id)
        if folder is None or not (folder / "data").exists():
            raise UploadError(GONE)
        return folder

    def put(self, key: str, upload_id: str, number: int, etag: str, size: int, written: Path) -> None:
        """Copy a written file to where it is the part of this number, in the place of an earlier one."""
        with self._alone(key, upload_id) as folder:
            each = _part_size(folder)
            if size > each:
                raise UploadError(f"part {number} has {size} bytes, more than the {each} of this upload's parts")
            for earlier in folder.glob(f"{number:05d}.*"):
                earlier.unlink()
            with (folder / "data").open("r+b", buffering=0) as data, written.open("rb", buffering=0) as source:
                data.seek((number - 1) * each)
                append(data, source)
                to_disk(data)
            (folder / f"{number:05d}.{etag}.{size}").touch()

    def parts(self, key: str, upload_id: str) -> list[Part]:
        """The parts that are there, by number. UploadError."""
        names = (path.name.split(".") for path in self.check(key, upload_id).glob("[0-9]*.*"))
        return sorted((Part(int(number), etag, int(size)) for number, etag, size in names), key=_number)

    @contextmanager
    def joined(self, key: str, upload_id: str, parts: Sequence[Part]) -> Iterator[Path]:
        """The parts, one after the other in a file that is to be moved away. UploadError when one is not there."""
        with self._alone(key, upload_id) as folder:
            stored = {part.number: part for part in self.parts(key, upload_id)}
            if not parts or sorted(part.number for part in parts) != list(range(1, len(parts) + 1)):
                raise UploadError("an upload is completed with each of its parts once")
            each = _part_size(folder)
            for part in sorted(parts, key=_number):
                there = stored.get(part.number)
                if there is None or there.etag != part.etag.strip('"'):
                    what = f"part {part.number} was not uploaded, or its etag is another"
                    raise UploadError(f"{what}: upload it again")
                if there.size != each and part.number < len(parts):
                    what = f"part {part.number} has {there.size} bytes, all but the last have {each}"
                    raise UploadError(f"{what}: upload it again")
            os.truncate(folder / "data", (len(parts) - 1) * each + (stored[len(parts)].size or 0))
            yield folder / "data"

    def drop(self, key: str, upload_id: str) -> None:
        """Delete an upload with its parts; nothing happens if there is none."""
        folder = self._of(key, upload_id)
        if folder is not None:
            with disk_errors():
                vanish(folder, self._aside)

    def pending(self) -> Iterator[Pending]:
        """The uploads that there are."""
        for folder in sorted(self._root.glob("*")):
            with suppress(FileNotFoundError):
                key = (folder / "key").read_text()
                yield Pending(key, folder.name, datetime.fromtimestamp((folder / "key").stat().st_mtime, UTC))

    def _of(self, key: str, upload_id: str) -> Path | None:
        """The upload's folder, None where there is none or it is that of another object."""
        folder = self._root / upload_id
        with suppress(FileNotFoundError):
            if _UPLOAD_ID.fullmatch(upload_id) and (folder / "key").read_text() == key:
                return folder
        return None

    @contextmanager
    def _alone(self, key: str, upload_id: str) -> Iterator[Path]:
        """The upload's folder while nobody else changes what is in it. UploadError, also where it is given up now."""
        folder = self.check(key, upload_id)
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                self.check(key, upload_id)  # joined while we waited
                yield folder
            finally:
                os.close(descriptor)
        except FileNotFoundError:
            raise UploadError(GONE) from None


def _part_size(folder: Path) -> int:
    return int((folder / "part_size").read_text())


def _number(part: Part) -> int:
    return part.number
