"""Members of zip and tar archives, one after the other, without believing what their headers say about sizes.

Tar is read here rather than by :mod:`tarfile`: that module holds extended headers of any declared size in memory, which
a crafted archive uses to fill it. Headers are decoded by the documented :meth:`tarfile.TarInfo.frombuf`.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, Literal

Kind = Literal["zip", "tar", "tar.gz", "tar.zst"]
CHUNK: Final = 1 << 20
_BLOCK: Final = 512
_ZIP_DAMAGE: Final = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    OverflowError,
)
"""All that zipfile lets out when bytes are wrong."""
_LONGEST_HEADER: Final = 1 << 20
"""Bytes of a tar extended header; real ones hold a path and a few times."""


class ArchiveFault(ValueError):  # noqa: N818  (a clause for a Problem, not an error by itself)
    """What is wrong with an archive or one of its members.

    Attributes:
        code: the problem's code.
        what: a clause.
        member: name of the member at fault, or None for the archive.
    """

    def __init__(self, code: str, what: str, member: str | None = None) -> None:
        super().__init__(what)
        self.code, self.what, self.member = code, what, member


@dataclass(frozen=True, slots=True)
class Member:
    """One file or folder of an archive.

    Attributes:
        name: as the archive has it.
        is_folder: True for a folder.
        chunks: the content; to be used up before the next member is asked for.
    """

    name: str
    is_folder: bool
    chunks: Callable[[], Iterator[bytes]]


def sniff(head: bytes) -> Kind | None:
    """The kind of an archive, from its first 512 bytes (fewer do, save for plain tar); None when it is none.

    For ``tar.gz`` and ``tar.zst`` only the outer layer shows.
    """
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return "zip"
    if head.startswith(b"\x1f\x8b\x08"):
        return "tar.gz"
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        return "tar.zst"
    if len(head) >= _BLOCK:
        try:
            tarfile.TarInfo.frombuf(head[:_BLOCK], "utf-8", "surrogateescape")
        except tarfile.HeaderError:
            return None
        return "tar"
    return None


def refuse_beyond(max_files: int, count: int) -> None:
    """ArchiveFault where there are as many files as that: the folder they go to counts as well."""
    if count >= max_files:
        raise ArchiveFault("too-many-files", f"it has more than {max_files} files and folders")


# --- zip --------------------------------------------------------------------------------------------------------------


def zip_members(file: BinaryIO, size: int, max_files: int) -> Iterator[Member]:
    """The members of a zip archive.

    Args:
        file: the archive, seekable.
        size: its length in bytes.
        max_files: refuse more entries than this before they are held in memory.

    Raises:
        ArchiveFault: encrypted, a link or device, an unknown compression, truncated or corrupt.
    """
    refuse_beyond(max_files, _zip_entries(file, size, max_files))
    try:
        archive = zipfile.ZipFile(file)
    except (*_ZIP_DAMAGE, OSError) as error:
        raise ArchiveFault("corrupt-archive", f"it is corrupt ({error})") from error
    with archive:
        for info in archive.infolist():
            _check_zip(info)
            yield Member(info.filename, info.filename.endswith("/"), _ZipContent(archive, info))


@dataclass(frozen=True, slots=True)
class _ZipContent:
    archive: zipfile.ZipFile
    info: zipfile.ZipInfo

    def __call__(self) -> Iterator[bytes]:
        try:
            with self.archive.open(self.info) as member:
                while chunk := member.read(CHUNK):
                    yield chunk
        except _ZIP_DAMAGE as error:
            raise ArchiveFault("corrupt-archive", f"it is corrupt ({error})", self.info.filename) from error
        except OSError as error:
            if error.errno != errno.EINVAL:  # what seeking to an offset before the file's start gives
                raise
            raise ArchiveFault("corrupt-archive", "it is corrupt: a member lies nowhere", self.info.filename) from error


def _check_zip(info: zipfile.ZipInfo) -> None:
    if "\0" in info.orig_filename:
        raise ArchiveFault("unsafe-path", "the member's name has control characters", info.orig_filename)
    if info.flag_bits & 0x1:
        raise ArchiveFault("encrypted-archive", "the member is encrypted", info.filename)
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        what = f"the member is compressed by method {info.compress_type}; only store and deflate are read"
        raise ArchiveFault("unknown-compression", what, info.filename)
    # The upper half holds the Unix mode, whichever system claims to have written the entry.
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise ArchiveFault("archive-link", "the member is a link", info.filename)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise ArchiveFault("archive-device", "the member is a device, pipe or socket", info.filename)


def _zip_entries(file: BinaryIO, size: int, limit: int) -> int:
    """Number of entries in the central directory, counted there, up to one more than the limit."""
    tail_size = min(size, (1 << 16) + 22)
    file.seek(size - tail_size)
    tail = file.read(tail_size)
    plain = tail[-22:-18] == b"PK\x05\x06" and tail[-2:] == b"\0\0"
    at = len(tail) - 22 if plain else tail.rfind(b"PK\x05\x06")
    if at < 0 or len(tail) - at < 22:
        raise ArchiveFault("truncated-archive", "it is truncated: the directory at the end of a zip file is missing")
    end = size - tail_size + at
    (length,) = struct.unpack_from("<I", tail, at + 12)
    if at >= 76 and tail[at - 20 : at - 16] == b"PK\x06\x07" and tail[at - 76 : at - 72] == b"PK\x06\x06":
        (length,) = struct.unpack_from("<Q", tail, at - 76 + 40)
        end -= 76
    if length > end:
        raise ArchiveFault("corrupt-archive", "it is corrupt: its directory is larger than the file")
    file.seek(end - length)
    count, position = 0, 0
    while position < length and count <= limit:
        header = file.read(46)
        if len(header) < 46 or not header.startswith(b"PK\x01\x02"):
            raise ArchiveFault("corrupt-archive", "it is corrupt: its directory cannot be read")
        skip = sum(struct.unpack_from("<HHH", header, 28))
        file.seek(skip, 1)
        position += 46 + skip
        count += 1
    return count


# --- tar --------------------------------------------------------------------------------------------------------------


def tar_members(read: Callable[[int], bytes]) -> Iterator[Member]:
    """The members of a tar stream: ustar, GNU and pax.

    Args:
        read: gives up to n bytes of the uncompressed stream, fewer only at its end.

    Raises:
        ArchiveFault: a link, device or sparse file, truncated or corrupt.
    """
    stream = _Blocks(read)
    long_name: str | None = None
    extended: dict[str, str] = {}
    first = True
    while True:
        block = stream.exactly(_BLOCK)
        if not block.strip(b"\0"):
            if first:
                raise ArchiveFault("not-an-archive", "it holds no tar archive")
            while read(CHUNK):  # to the end, where gzip and zstd keep their checksums
                pass
            return
        try:
            info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except tarfile.HeaderError as error:
            if first:
                raise ArchiveFault("not-an-archive", "it holds no tar archive") from error
            raise ArchiveFault("corrupt-archive", f"it is corrupt: a member's header is broken ({error})") from error
        first = False
        if info.type in (b"x", b"g", b"X", b"L", b"K"):
            content = stream.small(info)
            if info.type == b"L":
                long_name = content.split(b"\0", 1)[0].decode("utf-8", "surrogateescape")
            elif info.type in (b"x", b"X"):
                extended = _pax(content)
            continue
        name = extended.get("path", long_name if long_name is not None else info.name)
        size = _size(extended.get("size"), info.size, name)
        is_folder = _check_tar(info, extended, name)
        body = _TarContent(stream, 0 if is_folder else size, name)
        yield Member(name, is_folder, body)
        for _ in body():  # whatever the taker left
            pass
        if is_folder:
            stream.skip(size)
        long_name, extended = None, {}


def tar_files(file: BinaryIO, size: int, limit: int) -> int:
    """Number of files in a plain tar, counted from header to header without their content, up to the limit.

    To refuse by before anything is written: a million empty files take minutes to make and to delete. It stops where
    headers cannot be followed so easily; whoever reads the members then finds what is wrong, and counts all the same.
    """
    count, at = 0, 0
    while count < limit and at + _BLOCK <= size:
        block = os.pread(file.fileno(), _BLOCK, at)
        try:
            length, kind = tarfile.nti(block[124:136]), block[156:157]  # type: ignore[attr-defined]
        except tarfile.HeaderError:
            break
        if not block.strip(b"\0") or length < 0:
            break
        if kind in (b"x", b"X") and b"size=" in os.pread(file.fileno(), min(length, _LONGEST_HEADER), at + _BLOCK):
            break
        count += kind in (tarfile.REGTYPE, tarfile.AREGTYPE)
        at += _BLOCK + length + -length % _BLOCK
    return count


def _check_tar(info: tarfile.TarInfo, extended: dict[str, str], name: str) -> bool:
    """Whether a member is a folder; ArchiveFault when it is neither folder nor plain file."""
    if info.issym() or info.islnk():
        raise ArchiveFault("archive-link", "the member is a link", name)
    if info.ischr() or info.isblk() or info.isfifo():
        raise ArchiveFault("archive-device", "the member is a device or pipe", name)
    if info.type == tarfile.GNUTYPE_SPARSE or any(key.startswith("GNU.sparse.") for key in extended):
        raise ArchiveFault("archive-sparse", "the member is a sparse file", name)
    if info.isdir():
        return True
    if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.CONTTYPE):
        raise ArchiveFault("archive-device", f"the member is of the unknown type {info.type!r}", name)
    return False


def _size(extended: str | None, header: int, name: str) -> int:
    if extended is None:
        size = header
    elif extended.isascii() and extended.isdigit() and len(extended) < 20:
        size = int(extended)
    else:
        size = -1
    if size < 0:
        raise ArchiveFault("corrupt-archive", "it is corrupt: a member's size is no number", name)
    return size


def _pax(content: bytes) -> dict[str, str]:
    """Records ``length key=value\\n`` of a pax header."""
    records: dict[str, str] = {}
    position = 0
    while position < len(content) and content[position] != 0:
        space = content.find(b" ", position, position + 20)
        digits = content[position:space] if space > 0 else b""
        if not digits.isdigit() or int(digits) <= space - position:
            raise ArchiveFault("corrupt-archive", "it is corrupt: an extended header cannot be read")
        record = content[space + 1 : position + int(digits) - 1]
        if content[position + int(digits) - 1 : position + int(digits)] != b"\n":
            raise ArchiveFault("corrupt-archive", "it is corrupt: an extended header cannot be read")
        key, _, value = record.partition(b"=")
        records[key.decode("utf-8", "surrogateescape")] = value.decode("utf-8", "surrogateescape")
        position += int(digits)
    return records


@dataclass(slots=True)
class _Blocks:
    read: Callable[[int], bytes]

    def exactly(self, count: int, member: str | None = None) -> bytes:
        data = self.read(count)
        while len(data) < count:
            more = self.read(count - len(data))
            if not more:
                raise ArchiveFault("truncated-archive", "it is truncated: it ends before its last member does", member)
            data += more
        return data

    def small(self, info: tarfile.TarInfo) -> bytes:
        if not 0 <= info.size <= _LONGEST_HEADER:
            raise ArchiveFault("corrupt-archive", f"it is corrupt: an extended header of {info.size} bytes")
        content = self.exactly(info.size)
        self.exactly(-info.size % _BLOCK)
        return content

    def skip(self, size: int) -> None:
        for _ in _TarContent(self, size, None)():
            pass


class _TarContent:
    """The content of one member; calling it goes on where the last call stopped."""

    def __init__(self, stream: _Blocks, size: int, member: str | None) -> None:
        self._stream, self._left, self._padding, self._member = stream, size, -size % _BLOCK, member

    def __call__(self) -> Iterator[bytes]:
        while self._left:
            chunk = self._stream.exactly(min(CHUNK, self._left), self._member)
            self._left -= len(chunk)
            yield chunk
        padding, self._padding = self._padding, 0
        self._stream.exactly(padding, self._member)
