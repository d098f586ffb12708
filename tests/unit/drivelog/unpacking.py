"""Small archives of every kind, made in memory."""

import gzip
import io
import tarfile
import zipfile
from collections.abc import Callable

import zstandard

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
