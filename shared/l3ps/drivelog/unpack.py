"""Unpacking an archive that a stranger made, all or nothing.

Nothing an archive says about itself is believed: the kind comes from its first bytes, sizes are counted while writing,
and names are judged before a file exists. Files land in a temporary folder beside the target, which takes the target's
name when the last byte is there; whatever goes wrong, the folder is removed.
"""

from __future__ import annotations

import errno
import gzip
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Final

from ..errors import DriveLogError, Problem, ProcessingError
from ..progress import Progress, silent
from .archive_formats import ArchiveFault, Kind, Member, sniff, tar_members, zip_members
from .archive_names import UnsafeName, member_path, shown
from .open import open_drive
from .types import Drive

_ZSTD_WINDOW: Final = 1 << 27
"""Bytes of memory a zstd archive may ask for: what the zstd tool grants without ``--long``."""
_REPORT_EVERY: Final = 1 << 22


@dataclass(frozen=True, slots=True)
class UnpackLimits:
    """What an archive may grow to.

    Attributes:
        max_files: files and folders.
        max_file_bytes: bytes of one file.
        max_total_bytes: bytes of all files.
        max_ratio: bytes unpacked per byte of archive. Point clouds and images stay below 3, labels below 50.
        ratio_free_bytes: up to this size the ratio does not matter.
    """

    max_files: int = 1_000_000
    max_file_bytes: int = 8 << 30
    max_total_bytes: int = 512 << 30
    max_ratio: float = 100.0
    ratio_free_bytes: int = 64 << 20


_REMEDY: Final = {
    "not-an-archive": "Upload the log as .zip, .tar, .tar.gz or .tar.zst",
    "empty-archive": "Pack the log's folder and try again",
    "truncated-archive": "Pack or upload it again; the copy is not complete",
    "corrupt-archive": "Pack or upload it again; the copy is damaged",
    "encrypted-archive": "Pack the log without a password",
    "unknown-compression": "Pack the log as an ordinary .zip, as .tar.gz, or as .tar.zst without --long",
    "unsafe-path": "Pack the log's folder with plain relative names",
    "duplicate-path": "Pack every file once",
    "archive-link": "Pack the files themselves instead of links to them (tar: --dereference --hard-dereference)",
    "archive-device": "Pack files and folders only",
    "archive-sparse": "Pack the log without --sparse",
    "archive-bomb": "Pack the log itself; if this is one, ask for a higher limit of the compression ratio",
    "too-many-files": "Split the log into several archives, or ask for a higher limit",
    "file-too-large": "Leave this file out, or ask for a higher limit",
    "archive-too-large": "Split the log into several archives, or ask for a higher limit",
}
_OTHERS: Final = {b"BZh": "bzip2", b"\xfd7zXZ\0": "xz", b"7z\xbc\xaf\x27\x1c": "7-Zip", b"Rar!": "RAR"}


def unpack(
    archive: Path,
    target: Path,
    limits: UnpackLimits = UnpackLimits(),
    *,
    name: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Unpack an archive of a drive log.

    Args:
        archive: the file; its kind is told by its first bytes, not by its name.
        target: the folder to make; it must not exist, or be empty. Its parent is made when missing.
        limits: what the archive may grow to.
        name: what messages call the archive, when that is not its file name.
        progress: told the bytes of the archive read (stage ``unpack``); may raise to stop.

    Returns:
        The target. Files have default permissions; modes, owners and times in the archive are ignored.

    Raises:
        DriveLogError: not an archive, damaged, too large, or with a member that is no plain file with a plain name.
        ProcessingError: the target's disk is full.
        FileExistsError: the target is there and not empty.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FileExistsError(f"{target} exists and is not empty")
    label = name or archive.name
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    inner = partial / "log"  # the temporary folder itself is closed to others, the log is not
    try:
        inner.mkdir()
        _unpack_into(archive, inner, limits, progress)
        inner.rename(target)
    except ArchiveFault as fault:
        where = label if fault.member is None else f"{label}: {shown(fault.member)}"
        raise DriveLogError(Problem(fault.code, where, fault.what, _REMEDY[fault.code])) from fault
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise ProcessingError(f"{label}: there is no space left to unpack it in {target.parent}") from error
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def check_kind(head: bytes, size: int, name: str) -> Kind:
    """The kind of an archive, from its first 512 bytes.

    Args:
        head: the first 512 bytes, or all of a shorter file.
        size: length of the whole file.
        name: what messages call it.

    Raises:
        DriveLogError: empty, or no archive of a kind that is read.
    """
    try:
        return _kind(head, size)
    except ArchiveFault as fault:
        raise DriveLogError(Problem(fault.code, name, fault.what, _REMEDY[fault.code])) from fault


@contextmanager
def opened(
    path: Path,
    scratch: Path | None = None,
    limits: UnpackLimits = UnpackLimits(),
    *,
    sweeps: bool = False,
    skip_bad_scans: bool = False,
    progress: Progress = silent,
) -> Iterator[Drive]:
    """A drive from a folder or an archive; what was unpacked is removed at the end.

    Args:
        path: the log.
        scratch: where to unpack; the system's temporary folder when None.
        limits: what an archive may grow to.
        sweeps: as for :func:`open_drive`.
        skip_bad_scans: as for :func:`open_drive`.
        progress: as for :func:`unpack`.

    Raises:
        DriveLogError: no such log or archive, or one that cannot be used.
    """
    if not path.is_file():
        yield open_drive(path, sweeps=sweeps, skip_bad_scans=skip_bad_scans)
        return
    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="drive-", dir=scratch) as folder:
        root = unpack(path, Path(folder) / path.name, limits, progress=progress)  # its name is what messages show
        yield open_drive(root, sweeps=sweeps, skip_bad_scans=skip_bad_scans)


def _kind(head: bytes, size: int) -> Kind:
    if size == 0:
        raise ArchiveFault("not-an-archive", "the file is empty (0 bytes)")
    kind = sniff(head)
    if kind is None:
        other = next((tool for magic, tool in _OTHERS.items() if head.startswith(magic)), None)
        what = f"it is a {other} file, which is not read" if other else "it is not an archive"
        raise ArchiveFault("not-an-archive", what)
    return kind


def _unpack_into(archive: Path, folder: Path, limits: UnpackLimits, progress: Progress) -> None:
    size = archive.stat().st_size
    with archive.open("rb") as file:
        kind = _kind(file.read(512), size)
        file.seek(0)
        budget = _Budget(limits, size, file.tell, progress)
        sink = _Sink(folder, limits)
        for member in _members(kind, file, size, budget):
            sink.take(member, budget.spend if kind == "zip" else None)
    if not sink.files:
        raise ArchiveFault("empty-archive", "it has no file in it")
    progress("unpack", size, size)


def _members(kind: Kind, file: BinaryIO, size: int, budget: _Budget) -> Iterator[Member]:
    if kind == "zip":
        yield from zip_members(file, size, budget.limits.max_files)
        return
    # Members of a tar are a view of one stream, so the stream is what is counted: headers and padding too.
    with _uncompressed(kind, file) as read:
        yield from tar_members(budget.counted(read))


@contextmanager
def _uncompressed(kind: Kind, file: BinaryIO) -> Iterator[Callable[[int], bytes]]:
    """The tar stream inside a file; its faults as ArchiveFault, in whoever reads."""
    if kind == "tar":
        yield file.read
    elif kind == "tar.gz":
        with gzip.GzipFile(fileobj=file) as stream:
            yield _translated(stream.read, (EOFError, gzip.BadGzipFile, zlib.error))
    else:
        import zstandard  # noqa: PLC0415  (only who unpacks needs it; who looks at the first bytes does not)

        decompressor = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW)
        with decompressor.stream_reader(file, read_across_frames=True, closefd=False) as stream:
            yield _translated(stream.read, (zstandard.ZstdError,))


def _translated(read: Callable[[int], bytes], errors: tuple[type[Exception], ...]) -> Callable[[int], bytes]:
    def translating(count: int) -> bytes:
        try:
            return read(count)
        except EOFError as error:
            raise ArchiveFault("truncated-archive", "it is truncated: the compressed data ends too early") from error
        except errors as error:
            if "too much memory" in str(error):
                what = f"its zstd window is larger than {_ZSTD_WINDOW >> 20} MB"
                raise ArchiveFault("unknown-compression", what) from error
            raise ArchiveFault("corrupt-archive", f"it is corrupt ({error})") from error

    return translating


class _Budget:
    """Counts real bytes against the limits of the whole archive, and tells the progress."""

    def __init__(self, limits: UnpackLimits, size: int, position: Callable[[], int], progress: Progress) -> None:
        self.limits = limits
        self._size, self._position, self._progress = size, position, progress
        self._spent, self._reported = 0, 0
        self._by_ratio = max(limits.ratio_free_bytes, int(limits.max_ratio * size))

    def spend(self, count: int) -> None:
        self._spent += count
        if self._spent > self.limits.max_total_bytes:
            raise ArchiveFault("archive-too-large", f"it unpacks to more than {self.limits.max_total_bytes} bytes")
        if self._spent > self._by_ratio:
            what = f"it unpacks to more than {self.limits.max_ratio:g} times its size"
            raise ArchiveFault("archive-bomb", what)
        if self._spent - self._reported >= _REPORT_EVERY:
            self._reported = self._spent
            self._progress("unpack", min(self._position(), self._size), self._size)

    def counted(self, read: Callable[[int], bytes]) -> Callable[[int], bytes]:
        def counting(count: int) -> bytes:
            data = read(count)
            self.spend(len(data))
            return data

        return counting


class _Sink:
    """Writes members below a folder."""

    def __init__(self, folder: Path, limits: UnpackLimits) -> None:
        self._folder = folder
        self._limits = limits
        self._made = {PurePosixPath(".")}
        self.files = 0

    def take(self, member: Member, spend: Callable[[int], None] | None) -> None:
        """Write one member; ``spend`` is told the bytes of a format whose stream is not counted already."""
        try:
            path = member_path(member.name)
        except UnsafeName as error:
            raise ArchiveFault("unsafe-path", f"the member's name {error}", member.name) from error
        try:
            if member.is_folder:
                self._make(path)
            elif path == PurePosixPath("."):
                raise ArchiveFault("unsafe-path", "the member's name is empty", member.name)
            else:
                self._make(path.parent)
                self._write(self._folder / path, member, spend)
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            what = "the archive has this path twice, or as a file and as a folder"
            raise ArchiveFault("duplicate-path", what, member.name) from error

    def _make(self, path: PurePosixPath) -> None:
        if path in self._made:
            return
        for folder in (*reversed(path.parents), path):
            if folder not in self._made:
                self._count()
                (self._folder / folder).mkdir(exist_ok=True)
                self._made.add(folder)

    def _write(self, path: Path, member: Member, spend: Callable[[int], None] | None) -> None:
        self._count()
        written = 0
        with path.open("xb") as out:
            for chunk in member.chunks():
                written += len(chunk)
                if written > self._limits.max_file_bytes:
                    what = f"the member is larger than {self._limits.max_file_bytes} bytes"
                    raise ArchiveFault("file-too-large", what, member.name)
                if spend is not None:
                    spend(len(chunk))
                out.write(chunk)
        self.files += 1

    def _count(self) -> None:
        """One more file or folder; folders that a member's path implies count too."""
        if self.files + len(self._made) > self._limits.max_files:
            raise ArchiveFault("too-many-files", f"it has more than {self._limits.max_files} files and folders")
