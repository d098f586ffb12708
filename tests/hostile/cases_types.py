"""Files that are something else, and good archives cut at every place where a structure begins or ends."""

import io
import tarfile
import zipfile

from .archives import Files, gz, tarred, zeros_xz, zipped, zst
from .case import Case, case
from .samples import Samples

OTHERS = {
    "paper.zip": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n1 0 obj\n",
    "program.tar": b"\x7fELF\x02\x01\x01" + bytes(600),
    "page.tar.gz": b"<!doctype html><html><script>alert(1)</script></html>",
    "text.zip": b"hello\n",
    "picture.zip": b"\x89PNG\r\n\x1a\n" + bytes(600),
    "zeros.tar": bytes(10_240),
    "xz.tar": zeros_xz(),
    "bzip2.tar": b"BZh91AY&SY" + bytes(50),
    "seven.zip": b"7z\xbc\xaf\x27\x1c" + bytes(50),
    "rar.zip": b"Rar!\x1a\x07\x01\x00",
    "one-byte.zip": b"P",
    "database.zip": b"SQLite format 3\0" + bytes(500),
}
"""What no archive's first bytes begin with: refused when the upload is completed."""

_DOCUMENT: Files = {
    "[Content_Types].xml": b"<Types/>",
    "_rels/.rels": b"<Relationships/>",
    "word/document.xml": b"<w:document/>",
}


def cut_zip(content: bytes) -> dict[str, int]:
    """Where a zip's structures begin and end."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        first, second, *_ = archive.infolist()
        directory = archive.start_dir
    end = len(content) - 22
    name = len(first.filename)
    return {
        "in-first-local-header": 17,
        "after-first-local-header": 30 + name,
        "in-first-data": 30 + name + first.compress_size // 2,
        "before-second-local-header": second.header_offset,
        "in-second-local-header": second.header_offset + 29,
        "before-directory": directory,
        "in-directory-entry": directory + 20,
        "after-first-directory-entry": directory + 46 + name,
        "before-end-record": end,
        "in-end-record": end + 11,
        "one-byte-missing": len(content) - 1,
    }


def cut_tar(content: bytes) -> dict[str, int]:
    """The same of a tar."""
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        members = archive.getmembers()
    first, last = members[0], members[-1]
    past_last = last.offset_data + -(-last.size // 512) * 512
    return {
        "in-first-header": 400,
        "after-first-header": 512,
        "in-first-data": first.offset_data + first.size // 2,
        "before-last-header": last.offset,
        "in-last-header": last.offset + 100,
        "after-last-header": last.offset_data,
        "in-last-data": last.offset_data + last.size - 1,
        "in-padding": past_last - 1,
        "before-the-end-blocks": past_last,
    }


def cut_stream(content: bytes, head: int, tail: int) -> dict[str, int]:
    """The same of a compressed stream with headers of ``head`` and trailers of ``tail`` bytes."""
    return {
        "after-header": head,
        "in-data": len(content) // 2,
        "before-checksum": len(content) - tail,
    }


def _cut(kind: str, place: str) -> bytes:
    content = WHOLE[kind]
    return content[: PLACES[kind][place]]


_FEW: Files = {f"log/{number}.bin": bytes(range(256)) * (number + 3) for number in range(5)}
_FEW["log/last.bin"] = b"odd" * 111
WHOLE = {
    "zip": zipped(_FEW, zipfile.ZIP_DEFLATED),
    "tar": tarred(_FEW, tarfile.GNU_FORMAT),
    "tar.gz": gz(tarred(_FEW, tarfile.GNU_FORMAT)),
    "tar.zst": zst(tarred(_FEW, tarfile.GNU_FORMAT)),
}
PLACES = {
    "zip": cut_zip(WHOLE["zip"]),
    "tar": cut_tar(WHOLE["tar"]),
    "tar.gz": cut_stream(WHOLE["tar.gz"], 10, 8),
    "tar.zst": cut_stream(WHOLE["tar.zst"], 8, 4),
}
_DAMAGED = "truncated-archive corrupt-archive not-an-archive"


def _half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _model_as_drive(samples: Samples) -> bytes:
    return zipped(samples.bundle)


CASES: list[Case] = [
    *(case(name, content, "not-an-archive", name, end="completion") for name, content in OTHERS.items()),
    case("network.zip", lambda s: s.bundle["model.onnx"], "not-an-archive", "network.zip", end="completion"),
    case("letter.docx.zip", zipped(_DOCUMENT), "no-log"),
    case("model-as-drive.zip", _model_as_drive, "no-log"),
    case("gzip-of-text.tar.gz", gz(b"hello"), "truncated-archive not-an-archive"),
    case("gzip-of-nothing.tar.gz", gz(b""), "truncated-archive not-an-archive empty-archive"),
    case("only-a-zip-magic.zip", b"PK\x03\x04" + bytes(500), "truncated-archive corrupt-archive"),
    case("only-a-tar-magic.tar", bytes(257) + b"ustar\x0000" + bytes(3000), "not-an-archive corrupt-archive"),
    *(case(f"cut-{place}.{kind}", _cut(kind, place), _DAMAGED) for kind, places in PLACES.items() for place in places),
    case("half-a-log.zip", lambda s: _half(s.zip()), _DAMAGED),
    case("half-a-log.tar", lambda s: _half(s.tar()), _DAMAGED),
    case("half-a-log.tar.zst", lambda s: _half(zst(s.tar())), _DAMAGED),
]
