"""The object store as a directory, for the embedded stack. The API answers its presigned URLs.

DIR/objects/<key>            the objects
DIR/multipart/<id>/          uploads in progress (l3ps_platform.objects.folder_uploads)
DIR/tmp/                     half-written files; moved into place when complete
DIR/secret                   the HMAC key of presigned URLs, readable by the owner only
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from l3ps_platform.errors import ObjectMissing, StoreUnavailable
from l3ps_platform.objects.files import Incoming, append, disk_errors, half_written, to_disk, write_all
from l3ps_platform.objects.folder_uploads import FolderUploads
from l3ps_platform.objects.interface import ObjectInfo, Part, Pending
from l3ps_platform.objects.keys import check_key, check_prefix
from l3ps_platform.objects.signing import Grant, Signer


class DirectoryStore:
    """Objects as files below one directory.

    Args:
        root: the directory; made on first use.
        base_url: where clients reach the API, for presigned URLs.
    """

    def __init__(self, root: Path, base_url: str) -> None:
        self.root = root.absolute()
        self._base_url = base_url
        self._signer: Signer | None = None
        self._tmp = self.root / "tmp"
        self._uploads = FolderUploads(self.root / "multipart", self._tmp)

    @property
    def signer(self) -> Signer:
        """Signs and verifies this store's URLs, with a secret that all its processes share."""
        if self._signer is None:
            self._signer = Signer(self._secret(), self._base_url)
        return self._signer

    def ensure(self) -> None:
        """Create the directories if they are missing."""
        with disk_errors():
            for name in ("objects", "multipart", "tmp"):
                (self.root / name).mkdir(parents=True, exist_ok=True)

    def ping(self) -> None:
        """Raise StoreUnavailable unless the directory can be written to."""
        if not os.access(self.root / "objects", os.W_OK):
            raise StoreUnavailable(f"the object store {self.root} is missing or not writable")

    def path_of(self, key: str) -> Path:
        """Where an object lies, for the API to send it from. ObjectMissing."""
        path = self._path(key)
        if not path.is_file():
            raise ObjectMissing(key)
        return path

    @contextmanager
    def receive(self, grant: Grant) -> Iterator[Incoming]:
        """Take the body of a presigned PUT; it becomes the object or part on leaving without an exception."""
        target = self._path(grant.key)
        if grant.upload_id is not None:
            self._uploads.check(grant.key, grant.upload_id)
        with half_written(self._tmp) as (file, path):
            incoming = Incoming(file, grant.size)
            yield incoming
            incoming.check()
            if grant.upload_id is not None:
                self._uploads.put(grant.key, grant.upload_id, grant.part or 0, incoming.etag, incoming.size, path)
            else:
                to_disk(file)
                _move(path, target)

    def put_file(self, key: str, path: Path) -> None:
        """Store a file."""
        with self._replacing(self._path(key)) as file, path.open("rb", buffering=0) as source:
            append(file, source)

    def put_bytes(self, key: str, data: bytes) -> None:
        """Store bytes."""
        with self._replacing(self._path(key)) as file:
            write_all(file, data)

    def get_file(self, key: str, path: Path) -> None:
        """Fetch an object into a file."""
        with self.open(key) as source, disk_errors():
            partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
            try:
                with partial.open("wb", buffering=0) as file:
                    append(file, source)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)

    def get_bytes(self, key: str, offset: int = 0, length: int | None = None) -> bytes:
        """The object's bytes from ``offset`` on, at most ``length`` of them."""
        with self.open(key, offset) as file, disk_errors():
            return file.read(-1 if length is None else length)

    @contextmanager
    def open(self, key: str, offset: int = 0) -> Iterator[BinaryIO]:
        """A stream for reading."""
        path = self.path_of(key)
        try:
            file = path.open("rb", buffering=0)
        except FileNotFoundError:
            raise ObjectMissing(key) from None
        except OSError as error:
            raise StoreUnavailable(f"the object store failed on {key!r}: {error}") from error
        with file:
            file.seek(offset)
            yield file

    def stat(self, key: str) -> ObjectInfo:
        """Size, etag and age."""
        return self._info(key, self.path_of(key))

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""
        return self._path(key).is_file()

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """All objects below ``prefix``, in the order of their keys."""
        objects = self.root / "objects"
        top = objects / check_prefix(prefix)
        paths = (Path(folder) / name for folder, _, names in os.walk(top) for name in names)
        for path in sorted(paths, key=lambda p: p.relative_to(objects).as_posix()):
            with suppress(FileNotFoundError):  # deleted while we walk
                yield self._info(path.relative_to(objects).as_posix(), path)

    def delete(self, key: str) -> None:
        """Delete an object and the folders it leaves empty."""
        path = self._path(key)
        with disk_errors():
            path.unlink(missing_ok=True)
        with suppress(OSError):
            for folder in path.parents:
                if folder == self.root / "objects":
                    break
                folder.rmdir()

    def delete_prefix(self, prefix: str) -> int:
        """Delete all objects below ``prefix``."""
        keys = [info.key for info in self.list(prefix)]
        for key in keys:
            self.delete(key)
        return len(keys)

    def presign_get(self, key: str, seconds: int, filename: str | None = None) -> str:
        """A URL of the API that downloads the object."""
        return self.signer.url(Grant("GET", check_key(key), filename=filename), seconds)

    def presign_put(self, key: str, seconds: int) -> str:
        """A URL of the API that stores the body of one PUT."""
        return self.signer.url(Grant("PUT", check_key(key)), seconds)

    def create_multipart(self, key: str, part_size: int) -> str:
        """Begin a multipart upload."""
        return self._uploads.create(check_key(key), part_size)

    def presign_part(self, key: str, upload_id: str, number: int, seconds: int, size: int | None = None) -> str:
        """A URL of the API that stores the body of one PUT as a part."""
        return self.signer.url(Grant("PUT", check_key(key), upload_id, number, size), seconds)

    def list_parts(self, key: str, upload_id: str) -> Sequence[Part]:
        """The parts that have arrived."""
        with disk_errors():
            return self._uploads.parts(check_key(key), upload_id)

    def list_multipart(self) -> Iterator[Pending]:
        """Multipart uploads in progress."""
        with disk_errors():
            yield from self._uploads.pending()

    def complete_multipart(self, key: str, upload_id: str, parts: Sequence[Part]) -> ObjectInfo:
        """Join the parts in the order of their numbers."""
        target = self._path(key)
        with disk_errors(), self._uploads.joined(key, upload_id, parts) as whole:
            _move(whole, target)
        self._uploads.drop(key, upload_id)
        return self.stat(key)

    def abort_multipart(self, key: str, upload_id: str) -> None:
        """Drop an upload and its parts."""
        self._uploads.drop(check_key(key), upload_id)

    def tidy(self, before: datetime) -> int:
        """Delete what processes that died before then were writing."""
        count = 0
        for path in list(self._tmp.glob("*")):
            with suppress(FileNotFoundError):
                if datetime.fromtimestamp(path.stat().st_mtime, UTC) < before:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
                    count += 1
        return count

    def _path(self, key: str) -> Path:
        return self.root / "objects" / check_key(key)

    def _info(self, key: str, path: Path) -> ObjectInfo:
        stat = path.stat()
        return ObjectInfo(key, stat.st_size, f"{stat.st_mtime_ns:x}-{stat.st_size:x}", _utc(stat.st_mtime))

    @contextmanager
    def _replacing(self, target: Path) -> Iterator[BinaryIO]:
        """A temporary file that takes the place of ``target`` when complete and on disk."""
        with half_written(self._tmp) as (file, path):
            yield file
            to_disk(file)
            _move(path, target)

    def _secret(self) -> bytes:
        path = self.root / "secret"
        with disk_errors():
            self.root.mkdir(parents=True, exist_ok=True)
            fresh = self.root / f".secret-{secrets.token_hex(8)}"
            try:
                descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                with os.fdopen(descriptor, "w") as file:
                    file.write(secrets.token_hex(32))
                with suppress(FileExistsError):
                    os.link(fresh, path)  # whoever links first wins; all read the winner's
            finally:
                fresh.unlink(missing_ok=True)
            return path.read_text().encode()


def _utc(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _move(path: Path, target: Path) -> None:
    while True:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.replace(target)
            return
        except FileNotFoundError:  # a deletion took the empty folder away in this moment
            if not path.exists():
                raise
