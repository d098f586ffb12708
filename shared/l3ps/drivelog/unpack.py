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
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from ..errors import DriveLogError, Problem, ProcessingError
from ..progress import Progress, silent
from .archive_formats import ArchiveFault, Kind, Member, refuse_beyond, sniff, tar_files, tar_members, zip_members
from .archive_names import shown
from .open import open_drive
from .types import Drive
from .unpack_sink import USUAL, Budget, Sink, UnpackLimits

_ZSTD_WINDOW: Final = 1 << 27
"""Bytes of memory a zstd archive may ask for: what the zstd tool grants without ``--long``."""
_REMEDY: Final = {
    "not-an-archive": "Upload the {contents} as .zip, .tar, .tar.gz or .tar.zst",
    "empty-archive": "Pack the folder of the {contents} and try again",
    "truncated-archive": "Pack or upload it again; the copy is not complete",
    "corrupt-archive": "Pack or upload it again; the copy is damaged",
    "encrypted-archive": "Pack the {contents} without a password",
    "unknown-compression": "Pack the {contents} as an ordinary .zip, as .tar.gz, or as .tar.zst without --long",
    "unsafe-path": "Pack the folder of the {contents} with plain relative names",
    "duplicate-path": "Pack every file once",
    "archive-link": "Pack the files themselves instead of links to them (tar: --dereference --hard-dereference)",
    "archive-device": "Pack files and folders only",
    "archive-sparse": "Pack the {contents} without --sparse",
    "archive-bomb": "Pack nothing but the {contents}; if it is, ask for a higher limit of the compression ratio",
    "too-many-files": "Split the {contents} into several archives, or ask for a higher limit",
    "file-too-large": "Leave this file out, or ask for a higher limit",
    "archive-too-large": "Split the {contents} into several archives, or ask for a higher limit",
}
_OTHERS: Final = {b"BZh": "bzip2", b"\xfd7zXZ\0": "xz", b"7z\xbc\xaf\x27\x1c": "7-Zip", b"Rar!": "RAR"}


def unpack(
    archive: Path,
    target: Path,
    limits: UnpackLimits = USUAL,
    *,
    name: str | None = None,
    contents: str = "log",
    progress: Progress = silent,
) -> Path:
    """Unpack an archive of a drive log, or of annotated images.

    Args:
        archive: the file; its kind is told by its first bytes, not by its name.
        target: the folder to make; it must not exist, or be empty. Its parent is made when missing.
        limits: what the archive may grow to.
        name: what messages call the archive, when that is not its file name.
        contents: what remedies call what is in it.
        progress: told the bytes of the archive read (stage ``unpack``); may raise to stop.

    Returns:
        The target. Files have default permissions; modes, owners and times in the archive are ignored.

    Raises:
        DriveLogError: not an archive, damaged, too large, or with a member that is no plain file with a plain name.
        ProcessingError: the target's disk is full.
        FileExistsError: the target is there and not empty.
    """
    with _all_or_nothing(target, name or archive.name, contents) as folder:
        _unpack_into(archive, folder, limits, progress)
    return target


def gather(
    members: Iterable[Member], target: Path, limits: UnpackLimits = USUAL, *, name: str, contents: str = "log"
) -> Path:
    """Write files that come one by one and are named by a stranger, as :func:`unpack` writes those of an archive.

    Args:
        members: the files.
        target: as for :func:`unpack`.
        limits: of files and bytes; the ratio means nothing here.
        name: what messages call the place they come from.
        contents: what remedies call what they are.

    Returns:
        The target.

    Raises:
        DriveLogError: no file, too many or too large ones, or one whose name is no plain one.
        ProcessingError: the target's disk is full.
        FileExistsError: the target is there and not empty.
    """
    with _all_or_nothing(target, name, contents) as folder:
        budget = Budget(limits, None, lambda: 0, silent)
        sink = Sink(folder, limits)
        for member in members:
            sink.take(member, budget.spend)
        if not sink.files:
            raise ArchiveFault("empty-archive", "there is no file in it")
    return target


@contextmanager
def _all_or_nothing(target: Path, label: str, contents: str) -> Iterator[Path]:
    """A folder that becomes the target when the block ends well; faults as errors, and nothing left of a bad end."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FileExistsError(f"{target} exists and is not empty")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    inner = partial / "log"  # the temporary folder itself is closed to others, the log is not
    try:
        inner.mkdir()
        yield inner
        inner.rename(target)
    except ArchiveFault as fault:
        where = label if fault.member is None else f"{label}: {shown(fault.member)}"
        raise _error(fault, where, contents) from fault
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise ProcessingError(f"{label}: there is no space left to unpack it in {target.parent}") from error
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _error(fault: ArchiveFault, where: str, contents: str = "log") -> DriveLogError:
    return DriveLogError(Problem(fault.code, where, fault.what, _REMEDY[fault.code].format(contents=contents)))


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
        raise _error(fault, name) from fault


@contextmanager
def opened(
    path: Path,
    scratch: Path | None = None,
    limits: UnpackLimits = USUAL,
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
        budget = Budget(limits, size, file.tell, progress)
        sink = Sink(folder, limits)
        for member in _members(kind, file, size, budget):
            sink.take(member, budget.spend if kind == "zip" else None)
    if not sink.files:
        raise ArchiveFault("empty-archive", "it has no file in it")
    progress("unpack", size, size)


def _members(kind: Kind, file: BinaryIO, size: int, budget: Budget) -> Iterator[Member]:
    if kind == "zip":
        yield from zip_members(file, size, budget.limits.max_files)
        return
    if kind == "tar":
        refuse_beyond(budget.limits.max_files, tar_files(file, size, budget.limits.max_files))
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
