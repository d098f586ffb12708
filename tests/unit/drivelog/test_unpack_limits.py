"""Limits of what an archive may grow to, and headers that ask for memory."""

import gzip
import struct
import tarfile

import pytest
import zstandard

from l3ps.drivelog import UnpackLimits

from .unpacking import FILES, TAR, WHOLE, add_files, tarred, zipped

BIG = {"log/zeros": b"\0" * 3_000_000}
BOMB_LIMITS = UnpackLimits(ratio_free_bytes=1_000_000)


@pytest.mark.parametrize(
    "content",
    [
        zipped(BIG),
        gzip.compress(tarred(lambda a: add_files(a, BIG))),
        zstandard.ZstdCompressor().compress(tarred(lambda a: add_files(a, BIG))),
    ],
    ids=["zip", "gz", "zst"],
)
def test_bombs(place, content):
    assert place.refused(content, BOMB_LIMITS)[0] == "archive-bomb"
    assert place.unpack(content, UnpackLimits(ratio_free_bytes=4_000_000)) == BIG


def test_bomb_behind_the_end_of_the_tar(place):
    """What is only skipped is inflated too."""
    content = gzip.compress(TAR + b"\0" * 5_000_000)
    assert place.refused(content, BOMB_LIMITS)[0] == "archive-bomb"


def test_zip_whose_headers_lie_about_sizes(place):
    """The directory says 10 bytes; the data are 3,000,000."""
    content = bytearray(zipped(BIG))
    for at in (22, content.find(b"PK\x01\x02") + 24):
        struct.pack_into("<I", content, at, 10)
    assert place.refused(bytes(content), BOMB_LIMITS)[0] in {"corrupt-archive", "archive-bomb"}


def many_entries(count: int) -> bytes:
    """A zip whose directory names one member many times over."""
    one = zipped({"log/z0": b"\0" * 900_000})
    start = one.find(b"PK\x01\x02")
    entries = one[start:-22] * count
    return one[:start] + entries + one[-22:-14] + struct.pack("<HHII", count, count, len(entries), start) + one[-2:]


def test_zip_whose_members_share_their_data(place):
    """A small file, no nesting, and a great deal of output."""
    assert place.refused(many_entries(50), BOMB_LIMITS)[0] in {"duplicate-path", "archive-bomb", "corrupt-archive"}


def test_entries_are_counted_before_they_are_held(place):
    assert place.refused(many_entries(50), UnpackLimits(max_files=49))[0] == "too-many-files"


def test_files_of_a_tar_are_counted_before_the_first_is_looked_at(place):
    """A million empty ones would take minutes to make and to delete."""
    files = {"../evil": bytes(700)} | {f"log/{n}-{'x' * 3 * n}": bytes(n) for n in range(49)}
    content = tarred(lambda archive: add_files(archive, files))
    assert place.refused(content, UnpackLimits(max_files=50))[0] == "too-many-files"
    assert place.refused(content, UnpackLimits(max_files=51))[0] == "unsafe-path"


@pytest.mark.parametrize("kind", ["zip", "gz", "zst", "pax", "gnu", "ustar"])
def test_as_many_files_and_folders_as_the_limit_says_are_taken(place, kind):
    assert place.unpack(WHOLE[kind], UnpackLimits(max_files=6)) == FILES  # three, in two folders, and the target


@pytest.mark.parametrize("kind", ["zip", "gz", "zst", "pax"])
@pytest.mark.parametrize(
    ("limits", "code"),
    [
        (UnpackLimits(max_files=2), "too-many-files"),
        (UnpackLimits(max_file_bytes=1000), "file-too-large"),
        (UnpackLimits(max_total_bytes=1000), "archive-too-large"),
    ],
)
def test_limits(place, kind, limits, code):
    assert place.refused(WHOLE[kind], limits)[0] == code


def test_folders_that_a_path_implies_count_as_well(place):
    names = {f"{i}/" + "d/" * 20 + "f": b"" for i in range(5)}
    assert place.refused(tarred(lambda a: add_files(a, names)), UnpackLimits(max_files=50))[0] == "too-many-files"


def test_tar_header_that_asks_for_memory(place):
    """An extended header of a declared 8 GB must not be waited for."""
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, (1 << 33) - 1
    assert place.refused(TAR[:1536] + info.tobuf(tarfile.GNU_FORMAT) + b"\0" * 4096)[0] == "corrupt-archive"


def test_zstd_window_that_asks_for_memory(place):
    params = zstandard.ZstdCompressionParameters(window_log=30)
    stream = zstandard.ZstdCompressor(compression_params=params).compressobj()
    content = stream.compress(TAR) + stream.flush()
    code, message = place.refused(content)
    assert (code, "--long" in message) == ("unknown-compression", True)
