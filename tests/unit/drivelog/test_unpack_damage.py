"""Archives that are none, cut or damaged: refused in our own words, and nothing left behind."""

import gzip
import re
import struct

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps.drivelog import unpack
from l3ps.errors import DriveLogError

from .unpacking import WHOLE, add_file, tarred, zipped


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


def test_a_pax_record_that_runs_past_its_header(place):
    """It could otherwise hide a name from whoever reads it to the end."""
    content = tarred(lambda a: add_file(a, "log/" + "x" * 120))
    assert place.refused(re.sub(rb"\d{3} path=", b"999 path=", content))[0] == "corrupt-archive"


def test_what_is_packed_is_called_what_it_is(place):
    place.archive.parent.mkdir()
    place.archive.write_bytes(b"hello")
    with pytest.raises(DriveLogError, match=r"Upload the images as \.zip"):
        unpack(place.archive, place.target, contents="images")
