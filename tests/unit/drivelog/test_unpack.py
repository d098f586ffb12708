"""Unpacking: what comes out is what went in, and a hostile archive leaves nothing behind."""

import gzip
import io
import re
import stat
import struct
import tarfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps.drivelog import UnpackLimits, check_kind, opened, sniff, unpack
from l3ps.errors import Cancelled, DriveLogError

FILES = {"log/a.bin": b"points" * 100, "log/sub/b.txt": b"", "log/sub/c.bin": bytes(range(256)) * 9}


def tarred(add: Callable[[tarfile.TarFile], None], kind: int = tarfile.PAX_FORMAT) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=kind) as archive:
        add(archive)
    return out.getvalue()


def add_file(archive: tarfile.TarFile, name: str, content: bytes = b"x", mode: int = 0o644) -> None:
    info = tarfile.TarInfo(name)
    info.size, info.mode = len(content), mode
    archive.addfile(info, io.BytesIO(content))


def add_files(archive: tarfile.TarFile, files: dict[str, bytes] = FILES) -> None:
    for name, content in files.items():
        add_file(archive, name, content)


def zipped(files: dict[str, bytes] = FILES, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def zip_entry(name: str, mode: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        info = zipfile.ZipInfo(name)
        info.create_system, info.external_attr = 3, mode << 16
        archive.writestr(info, "/etc/passwd")
    return out.getvalue()


def special(kind: bytes) -> bytes:
    def add(archive: tarfile.TarFile) -> None:
        add_files(archive)
        info = tarfile.TarInfo("log/special")
        info.type, info.linkname = kind, "log/a.bin"
        archive.addfile(info)

    return tarred(add)


TAR = tarred(add_files)
WHOLE = {
    "zip": zipped(),
    "zip-stored": zipped(method=zipfile.ZIP_STORED),
    "pax": TAR,
    "gnu": tarred(add_files, tarfile.GNU_FORMAT),
    "ustar": tarred(add_files, tarfile.USTAR_FORMAT),
    "gz": gzip.compress(TAR),
    "two gz members": gzip.compress(TAR[:700]) + gzip.compress(TAR[700:]),
    "zst": zstandard.ZstdCompressor().compress(TAR),
    "two zst frames": zstandard.ZstdCompressor().compress(TAR[:700]) + zstandard.ZstdCompressor().compress(TAR[700:]),
}


@pytest.fixture
def place(tmp_path):
    """A folder with nothing but the archive: whatever else is there after a failure was left behind."""

    class Place:
        archive = tmp_path / "in" / "upload"
        target = tmp_path / "out" / "log"

        def unpack(self, content: bytes, limits: UnpackLimits = UnpackLimits(), **options) -> dict[str, bytes]:
            self.archive.parent.mkdir(exist_ok=True)
            self.archive.write_bytes(content)
            root = unpack(self.archive, self.target, limits, **options)
            assert self.left() == {self.target}
            return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}

        def refused(self, content: bytes, limits: UnpackLimits = UnpackLimits()) -> tuple[str, str]:
            with pytest.raises(DriveLogError) as caught:
                self.unpack(content, limits)
            assert self.left() == set()
            assert {p.name for p in tmp_path.iterdir()} <= {"in", "out"}
            (problem,) = caught.value.problems
            assert problem.remedy
            return problem.code, str(problem)

        def left(self) -> set[Path]:
            return set(self.target.parent.iterdir()) if self.target.parent.exists() else set()

    return Place()


@pytest.mark.parametrize("kind", WHOLE)
def test_what_went_in_comes_out(place, kind):
    assert place.unpack(WHOLE[kind]) == FILES


@pytest.mark.parametrize("kind", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT])
def test_long_and_foreign_names(place, kind):
    files = {"/".join(["verzeichnis" * 9] * 5) + "/ü.bin": b"1", "log/点云.bin": b"2"}
    assert place.unpack(tarred(lambda a: add_files(a, files), kind)) == files


def test_foreign_names_in_zip(place):
    assert place.unpack(zipped({"log/点云.bin": b"2"})) == {"log/点云.bin": b"2"}


def test_dots_in_names_and_folders_named_twice(place):
    def add(archive: tarfile.TarFile) -> None:
        for name in ("./", "./log", "./log/", "log//sub"):
            info = tarfile.TarInfo(name)
            info.type = tarfile.DIRTYPE
            archive.addfile(info)
        add_file(archive, "./log/./a.bin", b"1")

    assert place.unpack(tarred(add)) == {"log/a.bin": b"1"}


def test_nested_archives_are_just_files(place):
    inner = zipped({"../../evil": b"x"})
    assert place.unpack(zipped({"log/inner.zip": inner})) == {"log/inner.zip": inner}


def test_nothing_becomes_executable(place):
    place.unpack(tarred(lambda a: add_file(a, "run.sh", b"#!/bin/sh", 0o4777)))
    mode = (place.target / "run.sh").stat().st_mode
    assert not mode & (stat.S_IXUSR | stat.S_IXGRP | stat.S_IXOTH | stat.S_ISUID)


def test_a_target_in_use_is_not_touched(place):
    place.target.mkdir(parents=True)
    place.unpack(zipped())  # an empty folder may stand there
    with pytest.raises(FileExistsError):
        place.unpack(zipped({"other": b""}))
    assert (place.target / "log/a.bin").read_bytes() == FILES["log/a.bin"]


EVIL_NAMES = [
    "../evil",
    "log/../../evil",
    "/etc/cron.d/evil",
    "..",
    "C:/evil",
    "c:evil",
    "log\\..\\evil",
    "log/\nname",
    "log/\x7f",
    "log/" + "x" * 256,
    "/".join(["d"] * 40),
    "x/" * 600 + "y",
    "log/nul",
    "log/CON.bin",
    "log/name.",
    "log/name ",
]


@pytest.mark.parametrize("name", EVIL_NAMES)
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_names_that_lead_astray(place, name, kind):
    files = {"log/a": b"1", name: b"x"}
    content = zipped(files) if kind == "zip" else tarred(lambda a: add_files(a, files))
    code, message = place.refused(content)
    assert code == "unsafe-path"
    assert message.startswith("upload: ")


def test_names_that_are_no_text(place):
    assert place.refused(tarred(lambda a: add_file(a, "log/\udcff"), tarfile.GNU_FORMAT))[0] == "unsafe-path"
    assert place.refused(zipped({"log/a\x01": b""}).replace(b"a\x01", b"a\x00"))[0] == "unsafe-path"


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE])
def test_links_in_tar(place, kind):
    assert place.refused(special(kind))[0] == "archive-link"


@pytest.mark.parametrize("kind", [tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE, b"Z"])
def test_devices_in_tar(place, kind):
    assert place.refused(special(kind))[0] == "archive-device"


def test_links_and_devices_in_zip(place):
    assert place.refused(zip_entry("log/link", stat.S_IFLNK | 0o777))[0] == "archive-link"
    assert place.refused(zip_entry("log/pipe", stat.S_IFIFO | 0o644))[0] == "archive-device"


def test_sparse_files(place):
    assert place.refused(special(tarfile.GNUTYPE_SPARSE))[0] == "archive-sparse"

    def add(archive: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("log/sparse")
        info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.realsize": str(1 << 50)}
        archive.addfile(info)

    assert place.refused(tarred(add))[0] == "archive-sparse"


def test_encrypted_zip(place):
    content = bytearray(zipped({"log/a": b"1"}))
    content[6] |= 1  # flag bit 0 of the local header, and of the directory's entry
    content[content.find(b"PK\x01\x02") + 8] |= 1
    assert place.refused(bytes(content))[0] == "encrypted-archive"


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_zip_compressed_in_an_uncommon_way(place, method):
    assert place.refused(zipped(method=method))[0] == "unknown-compression"


@pytest.mark.parametrize("second", ["log/a", "log//a", "./log/a", "log/a/b"])
def test_one_path_twice(place, second):
    names = ["log/a", second]
    assert place.refused(tarred(lambda a: [add_file(a, name) for name in names]))[0] == "duplicate-path"
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive, warnings.catch_warnings(action="ignore"):
        for name in names:
            archive.writestr(name, b"x")
    assert place.refused(out.getvalue())[0] == "duplicate-path"


def test_folder_where_a_file_is(place):
    assert place.refused(tarred(lambda a: [add_file(a, name) for name in ("log/a/b", "log/a")]))[0] == "duplicate-path"


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


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "0 bytes"),
        (b"hello", "not an archive"),
        (b"x" * 5000, "not an archive"),
        (b"\0" * 5000, "not an archive"),
        (b"BZh91AY", "bzip2"),
        (b"\xfd7zXZ\0\0", "xz"),
        (b"7z\xbc\xaf\x27\x1c\0", "7-Zip"),
        (gzip.compress(b"hello"), "truncated|no tar"),
        (gzip.compress(b"x" * 5000), "no tar archive"),
        (gzip.compress(b"\0" * 5000), "no tar archive"),
        (zstandard.ZstdCompressor().compress(b"x" * 5000), "no tar archive"),
    ],
)
def test_not_an_archive(place, content, says):
    _, message = place.refused(content)
    assert re.search(says, message)
    assert message.startswith("upload: ")


def test_zip_members_that_lie_before_the_file(place):
    """A wrong offset of the directory makes every member's place negative."""
    content = bytearray(WHOLE["zip"])
    struct.pack_into("<I", content, len(content) - 6, len(content) * 2)
    assert place.refused(bytes(content))[0] == "corrupt-archive"


def test_zip_member_without_a_name(place):
    content = bytearray(zipped({"q": b"1"}))
    at = content.find(b"PK\x01\x02")
    struct.pack_into("<H", content, at + 28, 0)
    struct.pack_into("<H", content, at + 30, 1)  # the name's byte becomes an extra field
    assert place.refused(bytes(content))[0] in {"unsafe-path", "corrupt-archive"}


def test_empty_archives(place):
    assert place.refused(zipped({}))[0] == "empty-archive"
    assert place.refused(zipped({"log/": b""}))[0] == "empty-archive"


@pytest.mark.parametrize("kind", WHOLE)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_cut_anywhere_is_refused_and_leaves_nothing(tmp_path_factory, kind, data):
    """Save for the end of the padding behind the last member, without which nothing is lost."""
    content = WHOLE[kind]
    padding = {"pax": 4608, "gnu": 4608, "ustar": 4608, "zst": 12, "two zst frames": 12}.get(kind, 0)
    cut = content[: data.draw(st.integers(0, len(content) - padding - 1))]
    folder = tmp_path_factory.mktemp("cut")
    (folder / "a").write_bytes(cut)
    with pytest.raises(DriveLogError):
        unpack(folder / "a", folder / "out")
    assert [p.name for p in folder.iterdir()] == ["a"]


@pytest.mark.parametrize("kind", WHOLE)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_is_reported_in_our_own_words_or_harmless(tmp_path_factory, kind, data):
    """Any changed byte: either a clear refusal, or files inside the target; never another exception."""
    content = bytearray(WHOLE[kind])
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "a").write_bytes(bytes(content))
    try:
        unpack(folder / "a", folder / "out")
    except DriveLogError:
        assert [p.name for p in folder.iterdir()] == ["a"]
    else:
        assert sorted(p.name for p in folder.iterdir()) == ["a", "out"]


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(["..", ".", "", "a", "b.bin", "/", "\\", "C:", "nul"]), min_size=1, max_size=6))
def test_whatever_is_written_lies_in_the_target(tmp_path_factory, parts):
    folder = tmp_path_factory.mktemp("names")
    (folder / "a").write_bytes(tarred(lambda a: add_file(a, "/".join(parts))))
    try:
        unpack(folder / "a", folder / "in" / "out")
    except DriveLogError:
        assert not list((folder / "in").iterdir())
    else:
        assert [p.name for p in (folder / "in").iterdir()] == ["out"]
    assert sorted(p.name for p in folder.iterdir()) == ["a", "in"]


def test_stopping_leaves_nothing(place):
    def stop(stage: str, done: int, total: int) -> None:
        raise Cancelled(stage)

    with pytest.raises(Cancelled):
        place.unpack(zipped({"log/big": b"\0" * 9_000_000}), progress=stop)
    assert place.left() == set()


def test_message_names_the_upload_not_its_place_on_disk(place):
    place.archive.parent.mkdir()
    place.archive.write_bytes(special(tarfile.SYMTYPE))
    with pytest.raises(DriveLogError, match=r"^monday\.tar: log/special: the member is a link"):
        unpack(place.archive, place.target, name="monday.tar")


def test_kind_is_told_by_content():
    assert {kind: sniff(content[:512]) for kind, content in WHOLE.items()} == {
        "zip": "zip",
        "zip-stored": "zip",
        "pax": "tar",
        "gnu": "tar",
        "ustar": "tar",
        "gz": "tar.gz",
        "two gz members": "tar.gz",
        "zst": "tar.zst",
        "two zst frames": "tar.zst",
    }
    with pytest.raises(DriveLogError, match=r"drive\.zip: it is not an archive"):
        check_kind(b"hello", 5, "drive.zip")


def test_opened_archive_is_gone_afterwards(nuscenes_log, tmp_path):
    log = nuscenes_log()
    archive = tmp_path / "drive"  # no suffix: the name does not matter
    with tarfile.open(archive, "w:gz") as out:
        out.add(log.root, "wrapped/log")
    scratch = tmp_path / "scratch"
    with opened(archive, scratch) as drive:
        assert drive.root.is_relative_to(scratch)
        assert len(drive.scenes[0].scans[0].load_points()) == 300
    assert not list(scratch.iterdir())
    with opened(log.root) as drive:
        assert drive.root == log.root


def test_opened_archive_is_gone_after_an_error(tmp_path):
    (tmp_path / "a.zip").write_bytes(zipped())
    with (
        pytest.raises(DriveLogError, match=r"^a\.zip: no LiDAR log found"),
        opened(tmp_path / "a.zip", tmp_path / "scratch"),
    ):
        pass
    assert not list((tmp_path / "scratch").iterdir())
