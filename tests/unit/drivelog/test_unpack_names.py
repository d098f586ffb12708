"""Names of members: those that lead astray, and those that are one file on some system."""

import io
import tarfile
import warnings
import zipfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps.drivelog import ArchiveMember, UnpackLimits, gather, unpack
from l3ps.errors import DriveLogError

from .unpacking import add_file, add_files, tarred, zipped

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


LOOK_ALIKES = [
    "log/\uff0e\uff0e/evil",
    "log/\u2025/evil",
    "..\uff0fevil",
    "log\uff3cevil",
    "log/\u202egpj.exe",
    "a\u200bb",
]


@pytest.mark.parametrize("name", LOOK_ALIKES)
def test_names_that_other_systems_or_people_read_otherwise(place, name):
    assert place.refused(zipped({"log/a": b"1", name: b"x"}))[0] == "unsafe-path"


@pytest.mark.parametrize(
    "names", [("log/Scan", "log/scan"), ("LOG/a", "log/b"), ("\u00e4", "a\u0308"), ("stra\u00dfe", "STRASSE")]
)
def test_names_that_are_one_file_on_some_system(place, names):
    assert place.refused(zipped(dict.fromkeys(names, b"x")))[0] == "duplicate-path"


def test_files_from_elsewhere_are_judged_as_members_of_an_archive_are(place):
    def files(*names: str):
        return [ArchiveMember(name, False, lambda: iter([b"12", b"34"])) for name in names]

    gather(files("log/a", "log/b"), place.target, name="bucket/prefix")
    assert (place.target / "log/b").read_bytes() == b"1234"
    for names, limits, code in (
        (("../evil",), UnpackLimits(), "unsafe-path"),
        (("log/a", "log/A"), UnpackLimits(), "duplicate-path"),
        (("a", "b"), UnpackLimits(max_files=1), "too-many-files"),
        (("a",), UnpackLimits(max_file_bytes=3), "file-too-large"),
        (("a", "b"), UnpackLimits(max_total_bytes=5), "archive-too-large"),
        ((), UnpackLimits(), "empty-archive"),
    ):
        with pytest.raises(DriveLogError, match=r"^bucket/prefix") as caught:
            gather(files(*names), place.target.with_name("other"), limits, name="bucket/prefix")
        assert caught.value.problems[0].code == code
        assert place.left() == {place.target}
