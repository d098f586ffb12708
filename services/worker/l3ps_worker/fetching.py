"""Fetching inputs: uploads from the store, logs by reference from somebody else's bucket, within the same limits."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path

from l3ps.drivelog import ArchiveMember, UnpackLimits, gather, unpack
from l3ps.errors import InputError, Problem, ProcessingError
from l3ps.progress import Progress
from l3ps_platform.catalog import DriveRow
from l3ps_platform.errors import ObjectMissing, StoreUnavailable
from l3ps_platform.objects import ObjectInfo, Reference, SourceStore, find_source
from l3ps_platform.settings import Settings
from l3ps_worker.context import Context

_CHUNK = 1 << 20


class Fetched:
    """A drive on this worker's disk: an archive, or a folder of the log's files.

    Attributes:
        sha256: of the archive's bytes; of a folder, over the name and sha256 of each of its files, sorted by name.
        size: bytes fetched.
    """

    def __init__(self, path: Path, is_archive: bool, sha256: str, size: int) -> None:
        self._path, self._is_archive = path, is_archive
        self.sha256, self.size = sha256, size

    def unpack_to(self, target: Path, context: Context, name: str, progress: Progress) -> None:
        """Make the log's folder of it; may be done once. DriveLogError."""
        if self._is_archive:
            unpack(self._path, target, unpack_limits(context.settings), name=name, progress=progress)
        else:
            self._path.rename(target)


def fetch(context: Context, row: DriveRow, folder: Path, progress: Progress) -> Fetched:
    """Fetch a drive into a working folder.

    Raises:
        InputError: by reference, and nothing is there, more than the limits allow, or names that cannot be files.
        ProcessingError: the upload is gone, or the service may no longer read at the reference.
        StoreUnavailable: the store or bucket does not answer.
    """
    if row.source is None:
        archive_path = folder / "archive"
        sha256 = download(context, row.object_key, archive_path, row.size, progress)
        return Fetched(archive_path, True, sha256, row.size)
    reference = Reference.parse(row.source)
    source = find_source(context.settings, reference, row.project_id)
    if source is None:
        raise ProcessingError(f"{reference} is no longer among the sources of this service: ask whoever runs it")
    store = SourceStore(source)
    try:
        archive = store.find(reference.path) if reference.path else None
        if archive is not None:
            return _archive(context, store, archive, folder / "archive", progress)
        return _folder(context, store, reference, folder / "log", progress)
    except ObjectMissing as error:
        raise ProcessingError(f"{reference} changed while it was read: {error}; start the job again") from error


def fetch_again(context: Context, row: DriveRow, target: Path, folder: Path, progress: Progress) -> None:
    """Fetch a checked drive once more and make its folder. ProcessingError when it is not what was checked."""
    if row.source is None:
        upload = fetch(context, row, folder, progress)
        as_checked(upload.sha256, row.sha256)
        upload.unpack_to(target, context, row.filename, progress)
        return
    gone = f"the log at {row.source} has changed since it was checked: start a new job on it"
    try:
        fetched = fetch(context, row, folder, progress)
    except InputError as error:
        raise ProcessingError(f"{gone} ({error})") from error
    if fetched.sha256 != row.sha256:
        raise ProcessingError(gone)
    fetched.unpack_to(target, context, row.filename, progress)


def _archive(context: Context, store: SourceStore, info: ObjectInfo, path: Path, progress: Progress) -> Fetched:
    limit = context.settings.max_upload_bytes
    digest, done = hashlib.sha256(), 0
    with path.open("wb") as file:
        for chunk in _chunks(store, info.key):
            done += len(chunk)
            if done > limit:
                what = f"the archive has more than the {limit} bytes that one may have"
                raise InputError(Problem("archive-too-large", info.key, what, "Split the log into shorter drives"))
            file.write(chunk)
            digest.update(chunk)
            progress("fetch", done, max(info.size, done))
    return Fetched(path, True, digest.hexdigest(), done)


def _folder(context: Context, store: SourceStore, reference: Reference, target: Path, progress: Progress) -> Fetched:
    limits = unpack_limits(context.settings)
    found = store.walk(reference.path)
    first = next(found, None)
    if first is None:
        what = "there is no object of this name, and none below it"
        raise InputError(Problem("nothing-there", str(reference), what, "Correct the prefix, or put the log there"))
    digests: dict[str, str] = {}
    size = 0

    def counted(name: str, key: str) -> Iterator[bytes]:
        nonlocal size
        digest = hashlib.sha256()
        for chunk in _chunks(store, key):
            size += len(chunk)
            digest.update(chunk)
            progress("fetch", size, size)
            yield chunk
        digests[name] = digest.hexdigest()

    def members() -> Iterator[ArchiveMember]:
        prefix = f"{reference.path}/" if reference.path else ""
        for info in chain([first], found):
            name = info.key.removeprefix(prefix)
            content: Callable[[], Iterator[bytes]] = partial(counted, name, info.key)
            yield ArchiveMember(name, False, content)

    gather(members(), target, limits, name=str(reference))
    text = "".join(f"{sha256}  {name}\n" for name, sha256 in sorted(digests.items()))
    return Fetched(target, False, hashlib.sha256(text.encode()).hexdigest(), size)


def _chunks(store: SourceStore, key: str) -> Iterator[bytes]:
    with store.open(key) as stream:
        while chunk := stream.read(_CHUNK):
            yield chunk


def download(context: Context, key: str | None, path: Path, size: int, progress: Progress) -> str:
    """Fetch an object into a file and return its sha256; the progress step is ``fetch``, in bytes."""
    if key is None:
        raise ProcessingError("the uploaded archive is no longer in the store: upload it again")
    digest = hashlib.sha256()
    done = 0
    try:
        with context.store.open(key) as source, path.open("wb") as file:
            while chunk := source.read(_CHUNK):
                file.write(chunk)
                digest.update(chunk)
                done += len(chunk)
                progress("fetch", done, max(size, done))
    except ObjectMissing:
        raise ProcessingError("the uploaded archive is no longer in the store: upload it again") from None
    return digest.hexdigest()


def as_checked(found: str, known: str | None) -> None:
    """StoreUnavailable for an object that was checked and now reads otherwise: that is no fault of the upload."""
    if found != known:
        raise StoreUnavailable(f"the object store gave other bytes than were checked: sha256 {found[:12]}…")


def check_sha256(claimed: str | None, found: str, filename: str) -> None:
    """InputError for an upload that is not what its client announced."""
    if claimed is not None and claimed != found:
        what = f"its sha256 is {found[:12]}…, the client announced {claimed[:12]}…"
        raise InputError(Problem("damaged-upload", filename, what, "Upload it again."))


def unpack_limits(settings: Settings) -> UnpackLimits:
    """The unpacker's limits from the settings."""
    return UnpackLimits(
        max_files=settings.unpack_max_files,
        max_file_bytes=settings.unpack_max_file_bytes,
        max_total_bytes=settings.unpack_max_total_bytes,
        max_ratio=settings.unpack_max_ratio,
    )
