"""Multipart uploads of the directory store.

MULTIPART/<id>/key               the object it is to become
MULTIPART/<id>/00001.<md5>       a part; the name holds its number and etag, so a part is there whole or not at all
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from l3ps_platform.errors import UploadError
from l3ps_platform.objects.files import append, disk_errors, vanish
from l3ps_platform.objects.interface import GONE, Part, Pending

_UPLOAD_ID = re.compile(r"[0-9a-f]{32}")


class FolderUploads:
    """Parts in folders, one folder an upload.

    Args:
        root: the folder of folders.
        aside: on the same disk, for what is half made or half deleted.
    """

    def __init__(self, root: Path, aside: Path) -> None:
        self._root = root
        self._aside = aside

    def create(self, key: str) -> str:
        """A new upload; its id."""
        upload_id = secrets.token_hex(16)
        with disk_errors():
            folder = self._aside / upload_id
            folder.mkdir(parents=True)
            (folder / "key").write_text(key)
            self._root.mkdir(parents=True, exist_ok=True)
            folder.rename(self._root / upload_id)
        return upload_id

    def check(self, key: str, upload_id: str) -> Path:
        """The upload's folder. UploadError when it is not there or becomes another object."""
        folder = self._root / upload_id
        try:
            if _UPLOAD_ID.fullmatch(upload_id) and (folder / "key").read_text() == key:
                return folder
        except FileNotFoundError:
            pass
        raise UploadError(GONE)

    def put(self, key: str, upload_id: str, number: int, etag: str, written: Path) -> None:
        """Move a written file to where it is the part of this number, in the place of an earlier one."""
        folder = self.check(key, upload_id)
        name = f"{number:05d}.{etag}"
        try:
            written.rename(folder / name)
        except FileNotFoundError:  # aborted in this moment
            raise UploadError(GONE) from None
        for other in folder.glob(f"{number:05d}.*"):
            if other.name != name:
                other.unlink(missing_ok=True)

    def parts(self, key: str, upload_id: str) -> list[Part]:
        """The parts that are there, by number. UploadError."""
        found: dict[int, tuple[int, Part]] = {}
        for path in self.check(key, upload_id).glob("[0-9]*.*"):
            with suppress(FileNotFoundError):  # replaced in this moment
                stat = path.stat()
                number, _, etag = path.name.partition(".")
                part = Part(int(number), etag, stat.st_size)
                found[part.number] = max(found.get(part.number, (0, part)), (stat.st_mtime_ns, part), key=_age)
        return [found[number][1] for number in sorted(found)]

    def join(self, key: str, upload_id: str, parts: Sequence[Part], target: BinaryIO) -> None:
        """Write the parts one after the other. UploadError when one is not there."""
        folder = self.check(key, upload_id)
        ordered = sorted(parts, key=lambda part: part.number)
        if not ordered or len({part.number for part in ordered}) != len(ordered):
            raise UploadError("an upload is completed with each of its parts once")
        stored = {part.number: part.etag for part in self.parts(key, upload_id)}
        for part in ordered:
            if stored.get(part.number) != part.etag.strip('"'):
                raise UploadError(f"part {part.number} was not uploaded, or its etag is another: upload it again")
        try:
            for part in ordered:
                with (folder / f"{part.number:05d}.{stored[part.number]}").open("rb", buffering=0) as source:
                    append(target, source)
        except FileNotFoundError:
            raise UploadError(
                "a part was uploaded again, or the upload given up, while the parts were joined"
            ) from None

    def drop(self, upload_id: str) -> None:
        """Delete an upload with its parts."""
        with disk_errors():
            vanish(self._root / upload_id, self._aside)

    def pending(self) -> Iterator[Pending]:
        """The uploads that there are."""
        for folder in sorted(self._root.glob("*")):
            with suppress(FileNotFoundError):
                key = (folder / "key").read_text()
                yield Pending(key, folder.name, datetime.fromtimestamp((folder / "key").stat().st_mtime, UTC))


def _age(item: tuple[int, Part]) -> int:
    return item[0]
