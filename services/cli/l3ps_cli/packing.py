"""Directories made into single files for the upload: a log into a tar, a model bundle into a zip.

Both are reproducible (sorted names, no owners, no times), so the same directory always has the same sha256 and the
service recognises what it has seen before.
"""

from __future__ import annotations

import hashlib
import os
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from l3ps.errors import DriveLogError, Problem
from l3ps.segment.bundle import ModelBundle

Report = Callable[[int, int], None]
"""Called with (bytes done, bytes in all)."""

ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.zst")
_CHUNK = 1 << 20


def pack_log(log: Path, archive: Path, report: Report = lambda done, total: None) -> None:
    """Write a drive log's directory as an uncompressed tar (images are compressed already, points hardly shrink).

    Links are followed, so that a log assembled from links travels as what it shows. Raises DriveLogError when the
    directory holds no file.
    """
    files = list(_files(log))
    if not files:
        raise DriveLogError(
            Problem("empty-log", str(log), "the directory holds no files", "Name the directory of a drive log.")
        )
    total = sum(path.stat().st_size for path in files)
    done = 0
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in files:
            entry = tarfile.TarInfo(path.relative_to(log).as_posix())
            entry.size, entry.mode = path.stat().st_size, 0o644
            with path.open("rb") as source:
                tar.addfile(entry, source)
            done += entry.size
            report(done, total)


def pack_bundle(bundle: Path, archive: Path) -> None:
    """Write a model bundle's directory, one that ``bundle_name`` accepts, as a zip."""
    names = ("model.json", "about.json")
    description = next(path for name in names if (path := bundle / name).is_file())
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as target:
        for name, source in (("model.json", description), ("model.onnx", bundle / "model.onnx")):
            with source.open("rb") as content, target.open(zipfile.ZipInfo(name), "w", force_zip64=True) as member:
                while block := content.read(_CHUNK):
                    member.write(block)


def bundle_name(bundle: Path) -> str:
    """The name a model bundle (directory or zip) gives itself; ModelError when it is no bundle."""
    return ModelBundle.load(bundle).info.name


def sha256_of(path: Path, report: Report = lambda done, total: None) -> str:
    """Hex sha256 of a file."""
    digest, done, total = hashlib.sha256(), 0, path.stat().st_size
    with path.open("rb") as source:
        while block := source.read(_CHUNK):
            digest.update(block)
            done += len(block)
            report(done, total)
    return digest.hexdigest()


def is_archive_name(path: Path) -> bool:
    """Whether a file's name ends as one of the archives that the service takes."""
    return path.name.lower().endswith(ARCHIVE_SUFFIXES)


def _files(root: Path) -> Iterator[Path]:
    """Regular files under ``root`` in name order, links followed, no directory entered twice on one way down."""
    entered: set[tuple[int, int]] = set()
    for folder, folders, names in os.walk(root, followlinks=True):
        status = Path(folder).stat()
        entered.add((status.st_dev, status.st_ino))
        folders[:] = sorted(name for name in folders if not _is_entered(Path(folder, name), entered))
        yield from (path for name in sorted(names) if (path := Path(folder, name)).is_file())


def _is_entered(folder: Path, entered: set[tuple[int, int]]) -> bool:
    status = folder.stat()
    return (status.st_dev, status.st_ino) in entered
