"""Bombs, nests, headers that ask for memory, and sizes that lie."""

import struct
import tarfile

from .archives import (
    END,
    add_file,
    directory_entry,
    gz,
    header,
    local_header,
    overlapping_zip,
    padded,
    tar_of,
    tar_of_empty_files,
    tarred,
    with_size_field,
    zeros_gz,
    zip_end,
    zip_of_empty_files,
    zipped,
    zst,
)
from .case import FULL, Case, case

MANY = 1_000_000 if FULL else 3_000
"""Empty files: 10⁶ with the limit as it ships, else with a limit of 2,000."""
DEFLATED = 8
_HUGE = 80


def _zip_of_zeros(_: object) -> bytes:
    return zipped({"log/zeros": bytes(_HUGE << 20)}, DEFLATED)


def _many_small_bombs(_: object) -> bytes:
    return zipped({f"log/{number}": bytes(4 << 20) for number in range(20)}, DEFLATED)


def _tar_of_zeros(_: object) -> bytes:
    return header("log/zeros", _HUGE << 20) + bytes(_HUGE << 20) + END


def _behind_the_end(_: object) -> bytes:
    return gz(tarred({"log/a": b"1"})) + zeros_gz(_HUGE)


def _in_directory_padding(_: object) -> bytes:
    """A folder that declares content, which only has to be skipped."""
    return gz(header("log/", _HUGE << 20, tarfile.DIRTYPE)) + zeros_gz(_HUGE) + gz(END)


def _nested(depth: int) -> bytes:
    content = tarred({"log/a": b"1"})
    for level in range(depth):
        content = gz(tarred({f"log/{level}.tar": content})) if level % 2 else zipped({f"log/{level}.tar.gz": content})
    return content


def _zip_in_zip_of_bombs(_: object) -> bytes:
    """42.zip's kind: only whoever unpacks what was unpacked is hit."""
    inner = zipped({"zeros": bytes(8 << 20)}, DEFLATED)
    return zipped({f"log/{number}.zip": inner for number in range(16)}, DEFLATED)


def _pax(size: int, filler: bytes = b"x") -> bytes:
    """One pax record of this size and a member for it."""
    text = b"comment=" + filler * size + b"\n"
    length = len(text) + 1 + len(str(len(text) + 10))
    return header("pax", length, b"x") + padded(b"%d %s" % (length, text)) + header("log/a", 1) + padded(b"1") + END


def _pax_size(value: str) -> bytes:
    record = f"size={value}\n"
    text = f"{len(record) + 3} {record}".encode()
    return header("pax", len(text), b"x") + padded(text) + header("log/a", 1) + padded(b"1") + END


def _pax_that_never_ends(_: object) -> bytes:
    """Extended headers one after the other, and no member: 80 MB of them."""
    record = b"25 comment=aaaaaaaaaaaaa\n"
    return gz((header("pax", len(record), b"x") + padded(record)) * 80_000)


def _zip64_lies(size: int) -> bytes:
    """A member whose 64-bit sizes are as given; its data are three bytes."""
    name, content = b"log/a", b"abc"
    extra = struct.pack("<HHQQ", 1, 16, size, size)
    local = local_header(name, 0x352441C2, 0xFFFFFFFF, 0xFFFFFFFF, 0, extra) + content
    entry = directory_entry(name, 0x352441C2, 0xFFFFFFFF, 0xFFFFFFFF, 0, 0, extra)
    return local + entry + zip_end(1, len(entry), len(local))


def _zip_with(extra: bytes = b"", comment: bytes = b"", end_comment: bytes = b"", length: int | None = None) -> bytes:
    name, content = b"../evil", b"abc"
    local = local_header(name, 0x352441C2, 3, 3, 0, extra) + content
    entry = directory_entry(name, 0x352441C2, 3, 3, 0, 0, extra, comment)
    return local + entry + zip_end(1, len(entry) if length is None else length, len(local), end_comment)


def _end_in_the_comment(_: object) -> bytes:
    """A comment that holds another end record, so that two readers may see two archives."""
    fake = zip_end(0, 0, 0)
    return _zip_with(end_comment=fake + b"more")


def _wrong_offset(_: object) -> bytes:
    content = bytearray(zipped({"log/a": b"1"}))
    struct.pack_into("<I", content, len(content) - 6, len(content) * 2)
    return bytes(content)


def _sizes_that_lie(_: object) -> bytes:
    content = bytearray(zipped({"log/zeros": bytes(_HUGE << 20)}, DEFLATED))
    for at in (22, content.rfind(b"PK\x01\x02") + 24):
        struct.pack_into("<I", content, at, 10)
    return bytes(content)


def _long_names(_: object) -> bytes:
    name = b"log/" + b"x" * 900_000
    return tarred({"log/a": b"1"})[:1024] + header("././@LongLink", len(name), b"L") + padded(name) + header("a") + END


def _many_folders(_: object) -> bytes:
    """Few members whose paths imply thousands of folders; below the limit as it ships."""
    return tarred({f"{number}/{'d/' * 25}f": b"" for number in range(90)})


def _declared(size: int, kind: bytes) -> bytes:
    """An extended header of a declared size that nothing follows."""
    return header("././@LongLink", size, kind) + bytes(4096)


_NEGATIVE = b"\xff" * 12
_TOO_LARGE = b"\x80" + b"\xff" * 11
BOMB = "archive-bomb"
CORRUPT = "corrupt-archive"

CASES: list[Case] = [
    case("zeros.zip", _zip_of_zeros, BOMB),
    case("many-small-bombs.zip", _many_small_bombs, BOMB),
    case("overlapping.zip", lambda _: overlapping_zip(1000, 1 << 20), f"{BOMB} {CORRUPT}"),
    case("zeros.tar.gz", lambda _: zeros_gz(_HUGE), "not-an-archive"),
    case("file-of-zeros.tar.gz", lambda s: gz(_tar_of_zeros(s)), BOMB),
    case("file-of-zeros.tar.zst", lambda s: zst(_tar_of_zeros(s)), BOMB),
    case("behind-the-end.tar.gz", _behind_the_end, BOMB),
    case("in-a-folder.tar.gz", _in_directory_padding, BOMB),
    case("gz-in-gz.tar.gz", lambda s: gz(gz(s.tar())), "not-an-archive"),
    case("gz-in-gz-in-gz.tar.gz", lambda _: gz(gz(zeros_gz(_HUGE))), "not-an-archive truncated-archive"),
    case("zst-in-gz.tar.gz", lambda s: gz(zst(s.tar())), "not-an-archive"),
    case("zip-in-gz.tar.gz", lambda s: gz(s.zip()), "not-an-archive"),
    case("large-window.tar.zst", lambda s: zst(s.tar(), 30), "unknown-compression"),
    case("nested.zip", lambda _: _nested(7), "no-log"),
    case("log-in-an-archive-in-an-archive.zip", lambda s: zipped({"log.tar": s.tar()}), "no-log"),
    case("zips-of-bombs.zip", _zip_in_zip_of_bombs, "no-log"),
    case("pax-of-300-mb.tar.gz", lambda _: gz(_pax(300 << 20)), CORRUPT),
    case("pax-of-2-mb.tar", lambda _: _pax(2 << 20), CORRUPT),
    case("pax-without-end.tar.gz", _pax_that_never_ends, BOMB),
    case("pax-broken.tar", header("p", 9, b"x") + padded(b"99 a=b\n\n\n") + header("a") + END, CORRUPT),
    case("pax-size-negative.tar", _pax_size("-1"), CORRUPT, "log/a"),
    case("pax-size-huge.tar", _pax_size("9" * 30), CORRUPT, "log/a"),
    case("pax-size-of-an-exabyte.tar", _pax_size(str(1 << 60)), "truncated-archive", "log/a"),
    case("long-name-of-8-gb.tar", _declared((1 << 33) - 1, b"L"), CORRUPT),
    case("long-link-of-8-gb.tar", _declared((1 << 33) - 1, b"K"), CORRUPT),
    case("long-name.tar", _long_names, "unsafe-path"),
    case("negative-size.tar", with_size_field(header("log/a"), _NEGATIVE) + END, CORRUPT),
    case("endless-size.tar", with_size_field(header("log/a"), _TOO_LARGE) + END, f"{CORRUPT} truncated-archive"),
    case("size-no-number.tar", with_size_field(header("log/a"), b"0x10_hello!!") + END, f"{CORRUPT} not-an-archive"),
    case("size-lies.zip", _sizes_that_lie, f"{BOMB} {CORRUPT}", "log/zeros"),
    case("zip64-negative-size.zip", _zip64_lies((1 << 64) - 1), CORRUPT),
    case("zip64-exabyte.zip", _zip64_lies(1 << 60), CORRUPT),
    case("directory-larger-than-file.zip", _zip_with(length=1 << 30), CORRUPT),
    case("directory-offset-lies.zip", _wrong_offset, CORRUPT),
    case("large-extra.zip", _zip_with(extra=struct.pack("<HH", 0xCAFE, 65_000) + bytes(65_000)), "unsafe-path"),
    case("large-comment.zip", _zip_with(comment=bytes(65_535), end_comment=bytes(65_535)), f"unsafe-path {CORRUPT}"),
    case("end-in-the-comment.zip", _end_in_the_comment, f"unsafe-path {CORRUPT} empty-archive truncated-archive"),
    case("many-empty-files.zip", lambda _: zip_of_empty_files(MANY), "too-many-files"),
    case("many-empty-files.tar", lambda _: tar_of_empty_files(MANY), "too-many-files"),
    case("many-folders.tar", _many_folders, "too-many-files" if not FULL else "no-log"),
    case("encrypted.zip", lambda _: _encrypted(), "encrypted-archive", "log/a"),
    case("bzip2-inside.zip", zipped({"log/a": b"1" * 99}, 12), "unknown-compression", "log/a"),
    case("empty.zip", zipped({}), "empty-archive"),
    case("only-folders.tar", tar_of(lambda a: add_file(a, "log/", b"", type=tarfile.DIRTYPE)), "empty-archive"),
]


def _encrypted() -> bytes:
    content = bytearray(zipped({"log/a": b"1"}))
    content[6] |= 1
    content[content.find(b"PK\x01\x02") + 8] |= 1
    return bytes(content)
