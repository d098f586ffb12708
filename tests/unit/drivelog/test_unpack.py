"""Unpacking: what comes out is what went in."""

import stat
import tarfile

import pytest

from l3ps.drivelog import check_kind, opened, sniff, unpack
from l3ps.errors import Cancelled, DriveLogError

from .unpacking import FILES, WHOLE, add_file, add_files, special, tarred, zipped


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
