"""Manifests that were read: what jobs published, as it is looked up for one file and for all.

A manifest is never written again, so what was read of it is kept by its key. The largest, of 68,000 files, has 30 MB:
parsing it takes half a second and 90 MB for a moment, so only one is read at a time.
"""

from __future__ import annotations

import hashlib
import json
import sys
import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from l3ps_api.labels.layout import Layout
from l3ps_api.labels.schemas import Side
from l3ps_platform.objects import ObjectStore

KEPT_BYTES = 64 << 20
_FILE_BYTES = 700
"""Memory that one file takes, measured with 68,000 of them."""


@dataclass(frozen=True, slots=True)
class PublishedFile:
    """A file in a manifest; ``format`` is None where it belongs to every format (poses)."""

    path: str
    size: int
    sha256: str
    key: str
    format: str | None
    scene: str | None
    scan: str | None

    @property
    def side(self) -> Side | None:
        """Which labels it holds: those of the images alone, or the refined ones; None for poses and the like."""
        first = self.path.partition("/")[0]
        return first if first in ("primal", "refined") else None  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a job published.

    Attributes:
        files: in the order of the manifest.
        digest: of the manifest.
        places: of the files in ``files``, by path.
        layouts: of archives, by format and folder.
    """

    files: tuple[PublishedFile, ...]
    digest: str
    places: dict[str, int]
    layouts: dict[tuple[str, str], Layout] = field(default_factory=dict)

    @classmethod
    def parse(cls, data: bytes) -> Manifest:
        """Read a manifest."""
        files = tuple(_file(entry) for entry in json.loads(data)["files"])
        places = {file.path: number for number, file in enumerate(files)}
        return cls(files, hashlib.sha256(data).hexdigest(), places)

    def of_format(self, label_format: str, first: int = 0) -> Iterator[tuple[int, PublishedFile]]:
        """Number and file of each that belongs to a format, from a number on."""
        for number in range(first, len(self.files)):
            if self.files[number].format in (None, label_format):
                yield number, self.files[number]


class Manifests:
    """The manifests that were asked for last, within ``kept_bytes`` of memory, and the last one whatever its size."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._known: OrderedDict[str, Manifest] = OrderedDict()
        self._files = 0
        self._lock, self._reading = threading.Lock(), threading.Lock()

    def get(self, store: ObjectStore, key: str) -> Manifest:
        """The manifest of a key. ObjectMissing when its job has been deleted meanwhile."""
        found = self._recall(key)
        if found is None:
            with self._reading:
                found = self._recall(key) or self._keep(key, Manifest.parse(store.get_bytes(key)))
        return found

    def layout(self, store: ObjectStore, key: str, label_format: str, folder: str) -> Layout:
        """Where the files of a format, and behind them the manifest, lie in an archive below a folder."""
        manifest = self.get(store, key)
        found = manifest.layouts.get((label_format, folder))
        if found is None:
            last = len(self.shown(store, key, label_format))
            with self._reading:
                files = ((number, folder + file.path, file.size) for number, file in manifest.of_format(label_format))
                found = Layout.of(files, f"{folder}manifest.json", last)
                manifest.layouts[label_format, folder] = found
        return found

    def shown(self, store: ObjectStore, key: str, label_format: str) -> bytes:
        """The manifest as clients see it: with the files of one format, and without keys."""
        with self._reading:
            document: dict[str, Any] = json.loads(store.get_bytes(key))
            document["files"] = [
                {name: value for name, value in file.items() if name != "key"}
                for file in document["files"]
                if file["format"] in (None, label_format)
            ]
            return json.dumps(document, indent=1).encode()

    def _recall(self, key: str) -> Manifest | None:
        with self._lock:
            found = self._known.get(key)
            if found is not None:
                self._known.move_to_end(key)
            return found

    def _keep(self, key: str, manifest: Manifest) -> Manifest:
        with self._lock:
            self._known[key] = manifest
            self._files += len(manifest.files)
            while self._files * _FILE_BYTES > self._kept_bytes and len(self._known) > 1:
                _, oldest = self._known.popitem(last=False)
                self._files -= len(oldest.files)
        return manifest


def _file(entry: dict[str, Any]) -> PublishedFile:
    label_format, scene = entry["format"], entry.get("scene")
    return PublishedFile(
        path=entry["path"],
        size=entry["size"],
        sha256=entry["sha256"],
        key=entry["key"],
        format=None if label_format is None else sys.intern(label_format),
        scene=None if scene is None else sys.intern(scene),
        scan=entry.get("scan"),
    )
