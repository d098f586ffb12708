"""The labels of jobs as one tar that is never anywhere as a whole.

The manifests say every file's size, and a tar's headers follow from its files' names and sizes, so the length of the
archive and the place of every byte in it are known before a byte is read: it has a Content-Length and an ETag, and a
download goes on at any byte without looking at what lies before. In memory are one job's manifest and one block.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from l3ps_api.labels.layout import END, header, padded
from l3ps_api.labels.published import Published, published
from l3ps_api.services import Services
from l3ps_platform.errors import StoreUnavailable

_BLOCK = 1 << 19
_PIECE = 1 << 18
"""Each piece costs a visit to a thread: in pieces of a header each, eight archives kept all others waiting."""


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
        self._store, self._manifests = services.store, services.manifests
        self._folders: list[Folder] = []
        digest = hashlib.sha256()
        for job_id in job_ids:
            job = published(services, job_id, label_format)
            prefix = f"{job_id}/" if len(job_ids) > 1 else ""
            layout = self._manifests.layout(self._store, job.key, job.label_format, prefix)
            self._folders.append(Folder(job, prefix, layout.size))
            read = self._manifests.get(self._store, job.key).digest
            digest.update(json.dumps([prefix, job.label_format, int(job.finished_at.timestamp()), read]).encode())
        self.size = sum(folder.size for folder in self._folders) + len(END)
        self.etag = digest.hexdigest()[:32]

    def read(self, begin: int, end: int) -> Iterator[bytes]:
        """The bytes from ``begin`` up to ``end``, in pieces worth handing on: headers and small files together.

        Raises:
            StoreError: the store is away, or a file is gone or not what the manifest says.
        """
        piece = bytearray()
        for block in self._blocks(begin, end):
            piece += block
            if len(piece) >= _PIECE:
                yield bytes(piece)
                piece.clear()
        if piece:
            yield bytes(piece)

    def _blocks(self, begin: int, end: int) -> Iterator[bytes]:
        at = 0
        for folder in self._folders:
            if at < end and begin < at + folder.size:
                yield from self._read_folder(folder, max(begin - at, 0), min(end - at, folder.size))
            at += folder.size
        yield from _cut(END, at, begin, end)

    def _read_folder(self, folder: Folder, begin: int, end: int) -> Iterator[bytes]:
        key, label_format = folder.job.key, folder.job.label_format
        layout = self._manifests.layout(self._store, key, label_format, folder.prefix)
        files = self._manifests.get(self._store, key).files
        modified = int(folder.job.finished_at.timestamp())
        for member in range(layout.at(begin), layout.at(end - 1) + 1):
            file = files[layout.numbers[member]] if member < len(layout.numbers) else None
            path, size = (file.path, file.size) if file is not None else ("manifest.json", layout.last)
            head, at = header(folder.prefix + path, size, modified), layout.starts[member]
            yield from _cut(head, at, begin, end)
            at += len(head)
            first, last = max(begin - at, 0), min(end - at, size)
            if first < last and file is not None:
                yield from self._read_object(file.key, first, last)
            elif first < last:
                yield self._manifests.shown(self._store, key, label_format)[first:last]
            yield from _cut(bytes(padded(size) - size), at + size, begin, end)

    def _read_object(self, key: str, first: int, last: int) -> Iterator[bytes]:
        with self._store.open(key, first) as stream:
            while first < last:
                block = stream.read(min(_BLOCK, last - first))
                if not block:
                    raise StoreUnavailable(f"{key!r} is shorter than its manifest says")
                first += len(block)
                yield block


def _cut(data: bytes, at: int, begin: int, end: int) -> Iterator[bytes]:
    """What of ``data``, which lies at ``at``, is in the range."""
    piece = data[max(begin - at, 0) : max(end - at, 0)]
    if piece:
        yield piece
