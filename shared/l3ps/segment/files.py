"""The files of a model bundle, in a directory or a zip, read no further than the limits allow."""

from __future__ import annotations

import stat
import zipfile
import zlib
from abc import ABC, abstractmethod
from pathlib import Path

from l3ps.errors import ModelError, Problem

MAX_MODEL_BYTES = 8 << 30
"""Of a whole bundle; a ViT-g takes 4.6 GB."""
MAX_RATIO = 50
"""How much a file over 64 MB may shrink in a zip; weights shrink by a tenth, a zip bomb by a thousand."""


class BundleFiles(ABC):
    """The files of a bundle by name."""

    def __init__(self, where: str, names: set[str]) -> None:
        self.where = where
        self.names = names
        self._left = MAX_MODEL_BYTES

    def read(self, name: str, limit: int, *, linked: bool = True) -> bytes:
        """Content of a file; ``linked`` allows that it is a link, which a file that another one names may not be."""
        place = f"{self.where}/{name}"
        if name not in self.names:
            raise bundle_error("incomplete-model", place, "the bundle names this file but does not hold it")
        size, link = self._look(name)
        if link and not linked:
            raise bundle_error("linked-model", place, "it is a link, and only files of the bundle itself are read")
        if size > min(limit, self._left):
            raise bundle_error("model-too-large", place, f"it has {size} bytes, {min(limit, self._left)} are allowed")
        content = self._content(name, size)
        if len(content) > size:
            raise bundle_error("model-too-large", place, f"it unpacks to more than the {size} bytes it claims")
        self._left -= len(content)
        return content

    @abstractmethod
    def _look(self, name: str) -> tuple[int, bool]:
        """Bytes of a file as far as known without reading it, and whether it is a link."""

    @abstractmethod
    def _content(self, name: str, size: int) -> bytes:
        """The file, read up to one byte more than ``size``."""


class FolderFiles(BundleFiles):
    """A directory."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path), {p.name for p in path.iterdir() if p.is_file()})
        self._path = path

    def _look(self, name: str) -> tuple[int, bool]:
        path = self._path / name
        return path.stat().st_size, path.is_symlink()

    def _content(self, name: str, size: int) -> bytes:
        with (self._path / name).open("rb") as handle:
            return handle.read(size + 1)


class ZipFiles(BundleFiles):
    """An open zip; members may sit in one top folder."""

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive = archive
        self._members = {info.filename.rsplit("/", 1)[-1]: info for info in archive.infolist() if not info.is_dir()}
        super().__init__(where, set(self._members))

    def _look(self, name: str) -> tuple[int, bool]:
        member = self._members[name]
        if member.file_size > max(64 << 20, MAX_RATIO * member.compress_size):
            what = f"it unpacks from {member.compress_size} to {member.file_size} bytes, as no weights do"
            raise bundle_error("model-too-large", f"{self.where}/{name}", what)
        return member.file_size, stat.S_ISLNK(member.external_attr >> 16)

    def _content(self, name: str, size: int) -> bytes:
        # The header's size is a claim: read one byte past it and no further.
        try:
            with self._archive.open(self._members[name]) as handle:
                return handle.read(size + 1)
        except (NotImplementedError, RuntimeError, EOFError, zlib.error) as error:  # a method unknown here, a password
            raise bundle_error("not-a-model", f"{self.where}/{name}", f"it cannot be unpacked ({error})") from error


def bundle_error(code: str, where: str, what: str) -> ModelError:
    """An error about the bundle's make-up, with the remedy that fits all of them."""
    remedy = "A model bundle is a directory or zip that holds model.onnx, model.json and the files these name."
    return ModelError(Problem(code, where, what, remedy))
