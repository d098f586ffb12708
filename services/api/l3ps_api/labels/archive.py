"""The labels of jobs as one tar that is never anywhere as a whole.

The manifests say every file's size, and a tar's headers follow from its files' names and sizes, so the length of the
archive and the place of every byte in it are known before a byte is read: it has a Content-Length and an ETag, and a
download goes on at any byte without reading what lies before. In memory are one job's manifest and one block.
"""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from l3ps_api.labels.manifests import Published, published
from l3ps_api.services import Services
from l3ps_platform.errors import StoreUnavailable
from l3ps_platform.objects import ObjectStore

_BLOCK = 1 << 20
_END = bytes(2 * tarfile.BLOCKSIZE)


@dataclass(frozen=True, slots=True)
class Folder:
    """One job in the archive.

    Attributes:
        job: what it published.
        prefix: the folder's name with a slash, or nothing for an archive of one job.
        size: bytes of its part of the archive.
    """

    job: Published
    prefix: str
    size: int


class LabelArchive:
    """A tar of jobs' labels; the same jobs give the same bytes.

    Args:
        services: the process' connections.
        job_ids: the jobs; several get a folder each, named after them.
        label_format: the format; None: the first that each job was asked for.

    Raises:
        NotFound: no such job.
        ApiProblem: a job without labels, or without this format.
    """

    def __init__(self, services: Services, job_ids: Sequence[str], label_format: str | None) -> None:
        self._store: ObjectStore = services.store
        self._folders: list[Folder] = []
        digest = hashlib.sha256()
        for job_id in job_ids:
            job = published(services, job_id, label_format)
            prefix = f"{job_id}/" if len(job_ids) > 1 else ""
            manifest = job.manifest(self._store)
            size = sum(len(head) + _padded(length) for head, length, _ in _members(job, prefix, manifest))
            self._folders.append(Folder(job, prefix, size))
            digest.update(json.dumps([prefix, job.label_format, manifest], sort_keys=True).encode())
        self.size = sum(folder.size for folder in self._folders) + len(_END)
        self.etag = digest.hexdigest()[:32]

    def read(self, begin: int, end: int) -> Iterator[bytes]:
        """The bytes from ``begin`` up to ``end``.

        Raises:
            StoreError: the store is away, or a file is gone or not what the manifest says.
        """
        at = 0
        for folder in self._folders:
            if at < end and begin < at + folder.size:
                yield from self._read_folder(folder, at, begin, end)
            at += folder.size
        yield from _cut(_END, at, begin, end)

    def _read_folder(self, folder: Folder, at: int, begin: int, end: int) -> Iterator[bytes]:
        manifest = folder.job.manifest(self._store)
        for head, length, source in _members(folder.job, folder.prefix, manifest):
            yield from _cut(head, at, begin, end)
            at += len(head)
            first, last = max(begin - at, 0), min(end - at, length)
            if first < last and isinstance(source, bytes):
                yield source[first:last]
            elif first < last and isinstance(source, str):
                yield from self._read_object(source, first, last)
            yield from _cut(bytes(_padded(length) - length), at + length, begin, end)
            at += _padded(length)
            if at >= end:
                return

    def _read_object(self, key: str, first: int, last: int) -> Iterator[bytes]:
        with self._store.open(key, first) as stream:
            while first < last:
                block = stream.read(min(_BLOCK, last - first))
                if not block:
                    raise StoreUnavailable(f"{key!r} is shorter than its manifest says")
                first += len(block)
                yield block


def _members(job: Published, prefix: str, manifest: dict[str, Any]) -> Iterator[tuple[bytes, int, str | bytes]]:
    """Header, size and content (or the key of the object that holds it) of every file, the manifest's last."""
    files = list(job.files(manifest))
    for file in files:
        yield _header(job, f"{prefix}{file['path']}", file["size"]), file["size"], file["key"]
    shown = [{name: value for name, value in file.items() if name != "key"} for file in files]
    data = json.dumps({**manifest, "files": shown}, indent=1).encode()
    yield _header(job, f"{prefix}manifest.json", len(data)), len(data), data


def _header(job: Published, name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = size, 0o644, int(job.finished_at.timestamp())
    return info.tobuf(tarfile.PAX_FORMAT, "utf-8", "strict")


def _padded(size: int) -> int:
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


def _cut(data: bytes, at: int, begin: int, end: int) -> Iterator[bytes]:
    """What of ``data``, which lies at ``at``, is in the range."""
    piece = data[max(begin - at, 0) : max(end - at, 0)]
    if piece:
        yield piece
