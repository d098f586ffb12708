"""Archives that no ordinary tool would write, byte by byte, and those that one does."""

import gzip
import io
import lzma
import struct
import tarfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable

import zstandard

Files = dict[str, bytes]
BLOCK = 512


def zipped(files: Files | Iterable[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip; names may repeat when given as pairs."""
    out = io.BytesIO()
    pairs = files.items() if isinstance(files, dict) else files
    with zipfile.ZipFile(out, "w", method) as archive, warnings.catch_warnings(action="ignore"):
        for name, content in pairs:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def zip_of_kind(name: str, mode: int, content: bytes = b"/etc/passwd") -> bytes:
    """A zip whose one member has a Unix mode."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        info = zipfile.ZipInfo(name)
        info.create_system, info.external_attr = 3, mode << 16
        archive.writestr(info, content)
    return out.getvalue()


def tarred(files: Files | Iterable[tuple[str, bytes]], kind: int = tarfile.PAX_FORMAT) -> bytes:
    """A tar; names may repeat when given as pairs."""
    pairs = files.items() if isinstance(files, dict) else files
    return tar_of(lambda archive: [add_file(archive, name, content) for name, content in pairs], kind)


def tar_of(add: Callable[[tarfile.TarFile], object], kind: int = tarfile.PAX_FORMAT) -> bytes:
    """A tar that a function fills."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=kind) as archive:
        add(archive)
    return out.getvalue()


def add_file(archive: tarfile.TarFile, name: str, content: bytes = b"x", **fields: object) -> None:
    """A member with the given header fields."""
    info = tarfile.TarInfo(name)
    info.size = len(content)
    for field, value in fields.items():
        setattr(info, field, value)
    archive.addfile(info, io.BytesIO(content))


def header(name: str, size: int = 0, kind: bytes = tarfile.REGTYPE, link: str = "") -> bytes:
    """One tar header block, with a right checksum and whatever else is wanted."""
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = size, kind, link
    return info.tobuf(tarfile.GNU_FORMAT)[-BLOCK:]


def with_size_field(block: bytes, field: bytes) -> bytes:
    """A tar header with these 12 bytes for its size, and the checksum for them."""
    changed = bytearray(block)
    changed[124:136] = field
    changed[148:156] = b" " * 8
    changed[148:156] = b"%06o\0 " % sum(changed)
    return bytes(changed)


def padded(content: bytes) -> bytes:
    """Content filled up to whole blocks."""
    return content + bytes(-len(content) % BLOCK)


END = bytes(2 * BLOCK)
"""Ends a tar."""


def gz(content: bytes) -> bytes:
    """Gzip."""
    return gzip.compress(content, 6, mtime=0)


def zst(content: bytes, window_log: int | None = None) -> bytes:
    """Zstandard, with a checksum; in one frame of unknown length where a window is asked for."""
    if window_log is None:
        return zstandard.ZstdCompressor(write_checksum=True).compress(content)
    params = zstandard.ZstdCompressionParameters(window_log=window_log, write_checksum=True)
    stream = zstandard.ZstdCompressor(compression_params=params).compressobj()
    return stream.compress(content) + stream.flush()


def zeros_gz(count: int) -> bytes:
    """``count`` MB of zeros, compressed without ever being held."""
    packer, part = zlib.compressobj(9, zlib.DEFLATED, 31), bytes(1 << 20)
    return b"".join([*(packer.compress(part) for _ in range(count)), packer.flush()])


def zeros_xz() -> bytes:
    """A kind that is not read."""
    return lzma.compress(bytes(1 << 20))


# --- zip by hand ------------------------------------------------------------------------------------------------------


def local_header(name: bytes, crc: int, packed: int, size: int, method: int = 8, extra: bytes = b"") -> bytes:
    """What stands before a member's data."""
    fixed = struct.pack("<IHHHHHIIIHH", 0x04034B50, 20, 0, method, 0, 0x21, crc, packed, size, len(name), len(extra))
    return fixed + name + extra


def directory_entry(
    name: bytes,
    crc: int,
    packed: int,
    size: int,
    offset: int,
    method: int = 8,
    extra: bytes = b"",
    comment: bytes = b"",
) -> bytes:
    """A member's line in the directory at the end."""
    lengths = (len(name), len(extra), len(comment))
    fixed = struct.pack("<IHHHHHHIII", 0x02014B50, 20, 20, 0, method, 0, 0x21, crc, packed, size)
    return fixed + struct.pack("<HHHHHII", *lengths, 0, 0, 0, offset) + name + extra + comment


def zip_end(count: int, length: int, offset: int, comment: bytes = b"") -> bytes:
    """The end record; counts beyond 65535 wrap, as they do in archives that lack the 64-bit record."""
    fixed = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, count & 0xFFFF, count & 0xFFFF, length, offset, len(comment))
    return fixed + comment


def overlapping_zip(files: int, zeros: int) -> bytes:
    """Members that share one run of compressed zeros, each quoting the header of the next (Fifield 2019).

    A stored block of the deflate stream holds the next member's local header, so that each member's data go on into
    the next one's: the output grows with the square of the file.
    """
    content = bytes(zeros)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = packer.compress(content) + packer.flush()
    crc, size = zlib.crc32(content), zeros
    members: list[tuple[bytes, int, int, int, bytes]] = []
    for number in reversed(range(files)):
        name = b"log/%05d" % number
        own = local_header(name, crc, len(data), size)
        members.append((name, crc, len(data), size, own))
        if number:
            quote = b"\0" + struct.pack("<HH", len(own), len(own) ^ 0xFFFF)
            content = own + content
            crc, size = zlib.crc32(content), size + len(own)
            data = quote + own + data
    members.reverse()
    body = members[0][4] + data
    entries, offset = [], 0
    for name, own_crc, packed, own_size, own in members:
        entries.append(directory_entry(name, own_crc, packed, own_size, offset))
        offset += len(own) + 5  # the stored block's head stands before the quoted header
    directory = b"".join(entries)
    return body + directory + zip_end(files, len(directory), len(body))


def zip_of_empty_files(count: int) -> bytes:
    """A well-made zip of empty files, with the 64-bit record that more than 65535 of them need."""
    locals_, entries, offset = [], [], 0
    for number in range(count):
        name = b"%07d" % number
        head = local_header(name, 0, 0, 0, method=0)
        locals_.append(head)
        entries.append(directory_entry(name, 0, 0, 0, offset, method=0))
        offset += len(head)
    directory = b"".join(entries)
    record = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44, 45, 45, 0, 0, count, count, len(directory), offset)
    locator = struct.pack("<IIQI", 0x07064B50, 0, offset + len(directory), 1)
    return b"".join(locals_) + directory + record + locator + zip_end(0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF)


def tar_of_empty_files(count: int) -> bytes:
    """A tar of empty files."""
    block = bytearray(header("0" * 7))
    out = io.BytesIO()
    for number in range(count):  # a header by tarfile takes thirty times as long
        block[:7] = b"%07d" % number
        block[148:156] = b" " * 8
        block[148:156] = b"%06o\0 " % sum(block)
        out.write(block)
    return out.getvalue() + END
