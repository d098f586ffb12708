"""Where the members of an archive, or the objects of a folder in a bucket, become files: counted, judged, written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from ..progress import Progress
from .archive_formats import ArchiveFault, Member
from .archive_names import UnsafeName, member_path, same_file

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


USUAL: Final = UnpackLimits()


class Budget:
    """Counts real bytes against the limits of the whole archive, and tells the progress.

    Args:
        limits: the limits.
        size: bytes of the archive, or None where there is none and so no ratio.
        position: how far the archive has been read.
        progress: told of it.
    """

    def __init__(self, limits: UnpackLimits, size: int | None, position: Callable[[], int], progress: Progress) -> None:
        self.limits = limits
        self._size, self._position, self._progress = size or 0, position, progress
        self._spent, self._reported = 0, 0
        by_ratio = limits.max_total_bytes if size is None else int(limits.max_ratio * size)
        self._by_ratio = max(limits.ratio_free_bytes, by_ratio)

    def spend(self, count: int) -> None:
        """That many bytes more. ArchiveFault beyond a limit."""
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
        """The same reader, with what it reads spent."""

        def counting(count: int) -> bytes:
            data = read(count)
            self.spend(len(data))
            return data

        return counting


class Sink:
    """Writes members below a folder."""

    def __init__(self, folder: Path, limits: UnpackLimits) -> None:
        self._folder = folder
        self._limits = limits
        self._made = {PurePosixPath(".")}
        self._taken: set[int] = set()  # hashes: a million paths would be a hundred megabytes
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
                self._take(path)
                self._write(self._folder / path, member, spend)
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise _twice(member) from error

    def _make(self, path: PurePosixPath) -> None:
        if path in self._made:
            return
        for folder in (*reversed(path.parents), path):
            if folder not in self._made:
                self._count()
                self._take(folder)
                (self._folder / folder).mkdir()
                self._made.add(folder)

    def _take(self, path: PurePosixPath) -> None:
        """Take a path for good; FileExistsError where it is one that is taken already, here or on other systems."""
        key = hash(same_file(path))
        if key in self._taken:
            raise FileExistsError(path)
        self._taken.add(key)

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


def _twice(member: Member) -> ArchiveFault:
    what = "its path is there twice, or as a file and as a folder (upper and lower case are one on some systems)"
    return ArchiveFault("duplicate-path", what, member.name)
