"""The object store as a directory, for the embedded stack. The API answers its presigned URLs.

DIR/objects/<key>            the objects
DIR/multipart/<id>/00001     parts of uploads in progress, named by number; their md5 beside them
DIR/tmp/                     half-written files; moved into place when complete
DIR/secret                   the HMAC key of presigned URLs, readable by the owner only
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from l3ps_platform.errors import ObjectMissing, StoreUnavailable, UploadError
from l3ps_platform.objects.interface import ObjectInfo, Part
from l3ps_platform.objects.keys import check_key, check_prefix
from l3ps_platform.objects.signing import Grant, Signer

_CHUNK = 1 << 20
_UPLOAD_ID = re.compile(r"[0-9a-f]{32}")


class Incoming:
    """A body being received; written to a temporary file and hashed on the way."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._md5 = hashlib.md5(usedforsecurity=False)
        self.size = 0

    def write(self, data: bytes) -> None:
        """Append a chunk."""
        self._file.write(data)
        self._md5.update(data)
        self.size += len(data)

    @property
    def etag(self) -> str:
        """md5 of what came so far, as S3 names parts."""
        return self._md5.hexdigest()


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

    @property
    def signer(self) -> Signer:
        """Signs and verifies this store's URLs, with a secret that all its processes share."""
        if self._signer is None:
            self._signer = Signer(self._secret(), self._base_url)
        return self._signer

    def ensure(self) -> None:
        """Create the directories if they are missing."""
        with _disk_errors():
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
            target = self._upload(grant.upload_id, grant.key) / f"{grant.part:05d}"
        with self._replacing(target) as file:
            incoming = Incoming(file)
            yield incoming
        if grant.upload_id is not None:
            target.with_suffix(".md5").write_text(incoming.etag)

    def put_file(self, key: str, path: Path) -> None:
        """Store a file."""
        with path.open("rb") as source, self._replacing(self._path(key)) as file:
            shutil.copyfileobj(source, file, _CHUNK)

    def put_bytes(self, key: str, data: bytes) -> None:
        """Store bytes."""
        with self._replacing(self._path(key)) as file:
            file.write(data)

    def get_file(self, key: str, path: Path) -> None:
        """Fetch an object into a file."""
        with self.open(key) as source, _disk_errors():
            partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
            try:
                with partial.open("wb") as file:
                    shutil.copyfileobj(source, file, _CHUNK)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)

    def get_bytes(self, key: str, offset: int = 0, length: int | None = None) -> bytes:
        """The object's bytes from ``offset`` on, at most ``length`` of them."""
        with self.open(key) as file, _disk_errors():
            file.seek(offset)
            return file.read(-1 if length is None else length)

    @contextmanager
    def open(self, key: str) -> Iterator[BinaryIO]:
        """A stream for reading."""
        path = self.path_of(key)
        try:
            file = path.open("rb")
        except FileNotFoundError:
            raise ObjectMissing(key) from None
        except OSError as error:
            raise StoreUnavailable(f"the object store failed on {key!r}: {error}") from error
        with file:
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
        with _disk_errors():
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

    def create_multipart(self, key: str) -> str:
        """Begin a multipart upload."""
        check_key(key)
        upload_id = secrets.token_hex(16)
        with _disk_errors():
            folder = self.root / "multipart" / upload_id
            folder.mkdir(parents=True)
            (folder / "key").write_text(key)
        return upload_id

    def presign_part(self, key: str, upload_id: str, number: int, seconds: int) -> str:
        """A URL of the API that stores the body of one PUT as a part."""
        return self.signer.url(Grant("PUT", check_key(key), upload_id, number), seconds)

    def complete_multipart(self, key: str, upload_id: str, parts: Sequence[Part]) -> ObjectInfo:
        """Join the parts in the order of their numbers."""
        folder = self._upload(upload_id, key)
        ordered = sorted(parts, key=lambda part: part.number)
        if not ordered or len({part.number for part in ordered}) != len(ordered):
            raise UploadError("an upload is completed with each of its parts once")
        for part in ordered:
            stored = folder / f"{part.number:05d}.md5"
            if not stored.is_file() or stored.read_text() != part.etag.strip('"'):
                raise UploadError(f"part {part.number} was not uploaded, or its etag is another: upload it again")
        with self._replacing(self._path(key)) as file:
            for part in ordered:
                with (folder / f"{part.number:05d}").open("rb") as source:
                    shutil.copyfileobj(source, file, _CHUNK)
        shutil.rmtree(folder, ignore_errors=True)
        return self.stat(key)

    def abort_multipart(self, key: str, upload_id: str) -> None:
        """Drop an upload and its parts."""
        with suppress(UploadError):
            shutil.rmtree(self._upload(upload_id, key), ignore_errors=True)

    def _path(self, key: str) -> Path:
        return self.root / "objects" / check_key(key)

    def _upload(self, upload_id: str, key: str) -> Path:
        folder = self.root / "multipart" / upload_id
        if not _UPLOAD_ID.fullmatch(upload_id) or not (folder / "key").is_file() or (folder / "key").read_text() != key:
            raise UploadError("there is no such upload: it was completed, aborted or has expired; begin a new one")
        return folder

    def _info(self, key: str, path: Path) -> ObjectInfo:
        stat = path.stat()
        return ObjectInfo(key, stat.st_size, f"{stat.st_mtime_ns:x}-{stat.st_size:x}", _utc(stat.st_mtime))

    @contextmanager
    def _replacing(self, target: Path) -> Iterator[BinaryIO]:
        """A temporary file that takes the place of ``target`` when complete and on disk."""
        with _disk_errors():
            partial = self.root / "tmp" / secrets.token_hex(16)
            partial.parent.mkdir(parents=True, exist_ok=True)
            try:
                with partial.open("xb") as file:
                    yield file
                    file.flush()
                    os.fsync(file.fileno())
                target.parent.mkdir(parents=True, exist_ok=True)
                partial.replace(target)
            finally:
                partial.unlink(missing_ok=True)

    def _secret(self) -> bytes:
        path = self.root / "secret"
        with _disk_errors():
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


@contextmanager
def _disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreUnavailable(f"the object store's disk failed: {error}") from error
