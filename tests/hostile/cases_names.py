"""Names that lead elsewhere, and members that are no files."""

import stat
import tarfile
import unicodedata

from .archives import add_file, header, padded, tar_of, tarred, zip_of_kind, zipped
from .case import Case, case

ASTRAY = {
    "up": "../evil",
    "up-from-inside": "log/../../evil",
    "up-alone": "..",
    "absolute": "/etc/cron.d/evil",
    "absolute-twice": "//host/share/evil",
    "drive-letter": "C:/evil",
    "drive-letter-relative": "c:evil",
    "backslashes": "..\\..\\evil",
    "control-character": "log/a\nb",
    "escape-sequence": "log/\x1b[2Jb",
    "delete-character": "log/\x7f",
    "c1-control": "log/\x85b",
    "full-width-dots": "log/\uff0e\uff0e/evil",
    "two-dot-leader": "log/\u2025/evil",
    "full-width-slash": "..\uff0fevil",
    "full-width-backslash": "log\uff3cevil",
    "right-to-left-override": "log/\u202egpj.exe",
    "zero-width": "log/\u200b../evil",
    "device-name": "log/nul",
    "device-name-with-suffix": "log/COM1.bin",
    "ends-with-dot": "log/a.",
    "ends-with-space": "log/a ",
    "long-part": "log/" + "x" * 256,
    "long-path": "log/" + "x/" * 600 + "y",
    "deep": "/".join(["d"] * 40),
}
"""In a zip and in a tar each is refused with ``unsafe-path``."""

TWICE = {
    "same": ("log/a", "log/a"),
    "same-after-tidying": ("log/a", "log/./a"),
    "other-case": ("log/Scan.bin", "log/scan.bin"),
    "other-case-of-folder": ("LOG/a", "log/b"),
    "other-normalisation": ("log/\u00e4", unicodedata.normalize("NFD", "log/\u00e4")),
    "sharp-s": ("log/stra\u00dfe", "log/STRASSE"),
    "file-and-folder": ("log/a", "log/a/b"),
}
"""Pairs that are one file, here or on a system the log may be copied to."""


def _special(kind: bytes, link: str = "") -> bytes:
    return tarred({"log/a": b"x"})[:1024] + header("log/special", kind=kind, link=link) + bytes(1024)


def _through_a_link(_: object) -> bytes:
    """A link to a folder outside, then a file through it."""

    def add(archive: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("log")
        info.type, info.linkname = tarfile.SYMTYPE, "/tmp"
        archive.addfile(info)
        add_file(archive, "log/escaped.txt", b"out of here")

    return tar_of(add)


def _chain(_: object) -> bytes:
    """Links that lead out only together."""

    def add(archive: tarfile.TarFile) -> None:
        for name, target in (("a", "."), ("a/b", ".."), ("a/b/c", ".."), ("evil", "a/b/c/etc/passwd")):
            info = tarfile.TarInfo(name)
            info.type, info.linkname = tarfile.SYMTYPE, target
            archive.addfile(info)

    return tar_of(add)


def _sparse_pax(version: str) -> bytes:
    def add(archive: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("log/sparse")
        major, minor = version.split(".")
        info.pax_headers = {"GNU.sparse.major": major, "GNU.sparse.minor": minor, "GNU.sparse.realsize": str(1 << 50)}
        archive.addfile(info)

    return tar_of(add)


def _nul_in_zip(_: object) -> bytes:
    return zipped({"log/a\x01.txt": b""}).replace(b"a\x01.txt", b"a\x00.txt")


def _nul_in_pax(_: object) -> bytes:
    record = b"20 path=log/a\0/../b\n"
    return header("x", len(record), b"x") + padded(record) + header("y") + bytes(1024)


CASES: list[Case] = [
    *(case(f"{name}.zip", zipped({"log/a": b"1", at: b"x"}), "unsafe-path") for name, at in ASTRAY.items()),
    *(case(f"{name}.tar", tarred({"log/a": b"1", at: b"x"}), "unsafe-path") for name, at in ASTRAY.items()),
    case("nul.zip", _nul_in_zip, "unsafe-path", "a"),
    case("nul-in-pax.tar", _nul_in_pax, "unsafe-path", "log/a"),
    case("no-text.tar", tarred({"log/\udcff": b""}, tarfile.GNU_FORMAT), "unsafe-path", "\\udcff"),
    *(case(f"{name}.zip", zipped([(at, b"x") for at in pair]), "duplicate-path") for name, pair in TWICE.items()),
    *(case(f"{name}.tar", tarred([(at, b"x") for at in pair]), "duplicate-path") for name, pair in TWICE.items()),
    case("symbolic-link.tar", _special(tarfile.SYMTYPE, "/etc/passwd"), "archive-link", "special"),
    case("hard-link.tar", _special(tarfile.LNKTYPE, "log/a"), "archive-link", "special"),
    case("hard-link-to-the-outside.tar", _special(tarfile.LNKTYPE, "../../etc/passwd"), "archive-link", "special"),
    case("through-a-link.tar", _through_a_link, "archive-link", "log"),
    case("chain-of-links.tar", _chain, "archive-link"),
    case("link.zip", zip_of_kind("log/link", stat.S_IFLNK | 0o777), "archive-link", "link"),
    case("link-to-folder.zip", zip_of_kind("log/samples", stat.S_IFLNK | 0o777, b"/etc"), "archive-link", "samples"),
    case("character-device.tar", _special(tarfile.CHRTYPE), "archive-device", "special"),
    case("block-device.tar", _special(tarfile.BLKTYPE), "archive-device", "special"),
    case("pipe.tar", _special(tarfile.FIFOTYPE), "archive-device", "special"),
    case("unknown-type.tar", _special(b"Z"), "archive-device", "special"),
    case("second-volume.tar", _special(b"M"), "archive-device", "special"),
    case("pipe.zip", zip_of_kind("log/pipe", stat.S_IFIFO | 0o644), "archive-device", "pipe"),
    case("socket.zip", zip_of_kind("log/socket", stat.S_IFSOCK | 0o644), "archive-device", "socket"),
    case("device.zip", zip_of_kind("log/device", stat.S_IFBLK | 0o644), "archive-device", "device"),
    case("sparse.tar", _special(tarfile.GNUTYPE_SPARSE), "archive-sparse", "special"),
    case("sparse-0.1.tar", _sparse_pax("0.1"), "archive-sparse", "sparse"),
    case("sparse-1.0.tar", _sparse_pax("1.0"), "archive-sparse", "sparse"),
]
