"""COCO panoptic: one JSON file and a folder of PNG label maps whose colour is the segment's id, R + 256 G + 65536 B.

The JSON lies in the folder or in ``annotations/``; label maps in a folder of the JSON's name, ``panoptic/`` or
``masks/``; images in ``images/``, a folder of the JSON's name without ``panoptic_`` (``val2017/``), or beside. Crowds
are void; segments of thing categories are objects. Categories become the sixteen classes of Panoptic nuScenes and sky
where their names are known (COCO's, Cityscapes', nuScenes').
"""

from __future__ import annotations

import json
import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from l3ps.drivelog.names import is_inside
from l3ps.progress import Progress
from l3ps.taxonomy import NUSCENES16

from .assemble import Fault, Item, Truth, assembled, labels_of
from .classes import Mapped, read_classes
from .faults import Faults
from .files import DAMAGED, BadFile, size_of
from .names import known_class
from .types import NUSCENES_AND_SKY, AnnotationSet, spread

LAYOUT: Final = "a JSON with 'segments_info' in it or in annotations/ (COCO panoptic)"
_MARK: Final = b'"segments_info"'
_JSON: Final = "Write COCO's panoptic format: images, annotations with segments_info, categories"


def tables_of(folder: Path) -> list[Path]:
    """The panoptic JSON files of a folder."""
    found = (*sorted(folder.glob("*.json")), *sorted(folder.glob("annotations/*.json")))
    return [path for path in found if _has_segments(path)]


def is_coco(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return bool(tables_of(folder))


def read_coco(folder: Path, classes: Path | None, images: int | None, progress: Progress) -> AnnotationSet:
    """Read COCO panoptic annotations.

    Args:
        folder: that holds the JSON, or ``annotations/`` with it.
        classes: classes file that maps category ids or names; None takes the sixteen classes and sky.
        images: read so many, spread evenly; None reads all.
        progress: told the images looked at.

    Raises:
        AnnotationError: with everything that is wrong.
    """
    faults = Faults(folder)
    tables = tables_of(folder)
    if len(tables) > 1:
        names = ", ".join(map(faults.where, tables))
        faults.add("several-annotations", folder, f"it has several panoptic files ({names})", "Keep one of them there")
    faults.stop()
    content = _Content(tables[0], faults)
    mapped = content.map(classes)
    faults.stop()
    stem = tables[0].stem
    maps = [tables[0].parent / stem, folder / stem, folder / "panoptic", folder / "masks", tables[0].parent, folder]
    pictures = [folder / "images", folder / stem.removeprefix("panoptic_"), folder / "images" / stem, folder]
    pairs = sorted(content.pairs(), key=lambda pair: pair.picture)
    faults.stop()
    pairs = [pairs[i] for i in spread(len(pairs), images)]
    map_folder = _folder(maps, [pair.labels for pair in pairs])
    picture_folder = _folder(pictures, [pair.picture for pair in pairs])
    items = []
    for pair in pairs:
        labels = map_folder / pair.labels
        items.append(Item(pair.picture, picture_folder / pair.picture, partial(_truth, labels, pair, content)))
    return assembled(items, mapped, faults, progress, has_instances=any(content.is_thing.values()))


@dataclass(frozen=True)
class _Pair:
    """One annotated image: its file, its label map, and segment id → (category id, is a crowd)."""

    picture: str
    labels: str
    segments: Mapping[int, tuple[int, bool]]


class _Content:
    """The JSON: ``index`` is category id → class, ``is_thing`` category id → whether its segments are objects."""

    def __init__(self, path: Path, faults: Faults) -> None:
        self.path, self.faults = path, faults
        self.index: dict[int, int] = {}
        self.is_thing: dict[int, bool] = {}
        try:
            self.content = json.loads(path.read_text(encoding="utf-8-sig"))
        except (ValueError, RecursionError, OSError) as error:
            self._wrong(f"it cannot be read as JSON ({error})")
            faults.stop()
        lists = ("images", "annotations", "categories")
        if not isinstance(self.content, dict) or not all(_are_rows(self.content.get(key)) for key in lists):
            self._wrong(f"it does not hold the lists {', '.join(lists)}")
            faults.stop()

    def map(self, classes: Path | None) -> Mapped:
        """The classes; category ids of the annotations that have none become faults."""
        used = {s["category_id"] for a in self.content["annotations"] for s in _segments(a)}
        mapped = Mapped(NUSCENES_AND_SKY, {}) if classes is None else read_classes(classes)
        for row in self.content["categories"]:
            key, name = row.get("id"), row.get("name")
            if not isinstance(key, int) or not isinstance(name, str):
                self._wrong("a category has no 'id' or no 'name'")
                continue
            if classes is None:
                known = known_class(name)
                index = None if known is None else NUSCENES_AND_SKY.names.index(known)
            else:
                index = mapped.index.get(key, mapped.index.get(name))
            if index is not None:
                self.index[key] = index
                thing = bool(NUSCENES16.is_thing[mapped.classes.to_nuscenes[index]])
                self.is_thing[key] = bool(row.get("isthing", thing))
            elif key in used:
                what = f"no class is known for the category {key} ({name})"
                remedy = "Name this category in the file of --classes, as a class or under 'void'"
                self.faults.add("unknown-class", self.path, what, remedy)
        for key in sorted(used - {row.get("id") for row in self.content["categories"]}, key=str):
            self._wrong(f"a segment is of category {key!r}, which is not listed")
        return mapped

    def pairs(self) -> Iterator[_Pair]:
        """The annotated images."""
        pictures = {row.get("id"): row.get("file_name") for row in self.content["images"]}
        seen = set()
        for row in self.content["annotations"]:
            key, labels = row.get("image_id"), row.get("file_name")
            picture = pictures.get(key)
            if key in seen:
                self._wrong(f"image {key!r} is annotated twice")
            elif picture is None:
                self._wrong(f"an annotation is of image {key!r}, which is not listed")
            elif not all(isinstance(name, str) and is_inside(name) for name in (picture, labels)):
                self._wrong(f"the file names of image {key!r} are no relative names ({picture!r}, {labels!r})")
            elif len(_segments(row)) != len(row.get("segments_info") or []):
                self._wrong(f"a segment of image {key!r} has no whole 'id' or 'category_id'")
            else:
                segments = {s["id"]: (s["category_id"], bool(s.get("iscrowd"))) for s in _segments(row)}
                yield _Pair(picture, labels, segments)
            seen.add(key)
        lost = [name for key, name in pictures.items() if key not in seen]
        for name in lost:
            what = "it is listed, but has no annotation"
            self.faults.add("missing-counterpart", str(name), what, "Annotate it, or take it out of the JSON's images")

    def _wrong(self, what: str) -> None:
        self.faults.add("bad-annotations", self.path, what, _JSON)


def _has_segments(path: Path) -> bool:
    """Whether a JSON file mentions segments; it may be hundreds of megabytes, so it is searched and not parsed."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            return text.find(_MARK) >= 0
    except (OSError, ValueError):  # an empty file cannot be mapped
        return False


def _are_rows(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(row, dict) for row in value)


def _segments(annotation: dict[str, Any]) -> list[dict[str, Any]]:
    """The sound segments of an annotation."""
    rows = annotation.get("segments_info")
    if not isinstance(rows, list):
        return []
    return [
        row for row in rows if isinstance(row, dict) and all(type(row.get(k)) is int for k in ("id", "category_id"))
    ]


def _folder(folders: Sequence[Path], names: Sequence[str]) -> Path:
    """The folder that holds most of the files, the first of equals."""
    return max(folders, key=lambda folder: sum((folder / name).is_file() for name in names[:20]))


def _truth(labels: Path, pair: _Pair, content: _Content) -> Truth:
    ids = labels_of(labels, _read_ids)
    values, inverse = np.unique(ids, return_inverse=True)
    found = {int(value) for value in values if value}
    for what, lacking in (
        ("in no segments_info", found - pair.segments.keys()),
        ("in no pixel", pair.segments.keys() - found),
    ):
        if lacking:
            some = ", ".join(map(str, sorted(lacking)[:8]))
            remedy = "Write JSON and label maps in one go; their segment ids belong together"
            raise Fault("bad-labels", labels, f"{len(lacking)} segment id(s) are {what}: {some}", remedy)
    classes, instances = np.zeros(len(values), np.uint8), np.zeros(len(values), np.int32)
    for position, value in enumerate(values):
        category, crowd = pair.segments.get(int(value), (0, True))
        if value and not crowd:
            classes[position] = content.index[category]
            instances[position] = value if content.is_thing[category] else 0
    return classes[inverse].reshape(ids.shape), instances[inverse].reshape(ids.shape)


def _read_ids(path: Path) -> NDArray[np.int32]:
    """Segment ids of a label map."""
    size_of(path)
    try:
        with Image.open(path) as image:
            if image.mode not in ("RGB", "RGBA"):
                raise BadFile(f"it is of mode {image.mode}, not a colour image whose colours are segment ids")
            planes = np.asarray(image.convert("RGB"), dtype=np.int32)
    except DAMAGED as error:
        raise BadFile(str(error) if isinstance(error, BadFile) else f"it cannot be decoded ({error})") from error
    return np.asarray(planes[..., 0] + 256 * planes[..., 1] + 65536 * planes[..., 2], dtype=np.int32)
