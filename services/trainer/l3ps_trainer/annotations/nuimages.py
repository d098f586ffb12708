"""nuImages: tables in ``v1.0-*``, masks as base64 run lengths inside them.

Painted as nuScenes' own tools do: surfaces in the order of their table, then objects in the order of their tokens over
them. What nobody painted is void. Categories become the sixteen classes of Panoptic nuScenes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from l3ps.drivelog.names import resolve, subfolders
from l3ps.drivelog.tables import Row, Table, is_flag, is_text, is_token, read_table, unique
from l3ps.errors import Problem
from l3ps.progress import Progress

from .assemble import Fault, Item, Truth, assembled
from .classes import Mapped, read_classes
from .faults import Faults
from .files import BadFile, size_of
from .names import known_class
from .rle import BadMask, decode_base64
from .types import NUSCENES_AND_SKY, AnnotationSet, spread

LAYOUT: Final = "v1.0-*/ with object_ann.json or surface_ann.json (nuImages)"
_EXPORT: Final = "Copy the nuImages tables again; all tables of a version belong together"


def _anything(value: object) -> bool:
    """Judged by whoever uses it."""
    return True


_KEYS: Final = {"category_token": is_token, "sample_data_token": is_token}
_ANNOTATED = {name: Table(name, _KEYS, required=False) for name in ("surface_ann", "object_ann")}
_MASKS = {
    name: Table(name, {"token": is_token, **_KEYS, "mask": _anything}, required=False)
    for name in ("surface_ann", "object_ann")
}
_DATA: Final = Table("sample_data", {"token": is_token, "filename": is_text, "is_key_frame": is_flag})
_CATEGORY: Final = Table("category", {"token": is_token, "name": is_token})


def tables_of(folder: Path) -> list[Path]:
    """The folders of nuImages tables in a folder, or itself."""
    here = [folder] if folder.name.startswith("v1.0-") else subfolders(folder)
    return [
        p for p in here if p.name.startswith("v1.0-") and any((p / f"{name}.json").is_file() for name in _ANNOTATED)
    ]


def is_nuimages(folder: Path) -> bool:
    """Whether a folder has this layout, or is the folder of the tables."""
    return bool(tables_of(folder))


def read_nuimages(folder: Path, classes: Path | None, images: int | None, progress: Progress) -> AnnotationSet:
    """Read nuImages.

    Args:
        folder: that holds the folder of tables, or that folder itself.
        classes: classes file that maps category names; None takes the sixteen classes.
        images: read so many, spread evenly; None reads all that have an annotation.
        progress: told the images looked at.

    Raises:
        AnnotationError: with everything that is wrong.
    """
    versions = tables_of(folder)
    root = versions[0].parent
    faults = Faults(root)
    if len(versions) > 1:
        names = ", ".join(p.name for p in versions)
        faults.add("several-annotations", folder, f"it has several sets of tables ({names})", "Name one of these")
        faults.stop()
    log = _Log(versions[0], faults)
    rows, notes = log.pictures(images)
    mapped, index = log.classes(classes)
    drawn = log.masks({row["token"] for row in rows})
    faults.stop()
    items = []
    for row in rows:
        path = resolve(root, row["filename"], f"{log.folder.name}/sample_data.json")
        if isinstance(path, Problem):
            faults.extend([path])
        else:
            items.append(Item(row["filename"], path, partial(_truth, path, drawn.get(row["token"], []), index)))
    return assembled(items, mapped, faults, progress, has_instances=log.has_objects, notes=notes)


@dataclass(frozen=True)
class _Drawn:
    """One mask: ``where`` names its row, ``instance`` is 0 for a surface."""

    where: str
    category: str
    mask: Any
    instance: int


class _Log:
    """The tables of one version.

    The tables of masks are read twice: which images have any, then the masks of those that are wanted. The whole of
    nuImages holds 0.7 million masks, thirty images of it a few hundred.
    """

    def __init__(self, folder: Path, faults: Faults) -> None:
        self.folder, self.faults = folder, faults
        self.categories = {r["token"]: r["name"] for r in self._unique(_CATEGORY)}
        self.used: Counter[str] = Counter()
        self.annotated: set[str] = set()
        self.has_objects = False
        for name, table in _ANNOTATED.items():
            for row in self._rows(table):
                self.annotated.add(row["sample_data_token"])
                self.used[row["category_token"]] += 1
                self.has_objects |= name == "object_ann"
        faults.stop()  # what a broken table lacks would be missed by every row that names it
        for token in self.used.keys() - self.categories.keys():
            what = f"{self.used[token]} annotation(s) name the category {token}, which is not there"
            faults.add("missing-row", f"{folder.name}/category.json", what, _EXPORT)

    def pictures(self, images: int | None) -> tuple[list[Row], list[Problem]]:
        """The annotated images by file name, and what is said about the others."""
        rows = self._unique(_DATA, lambda row: bool(row["is_key_frame"]) or row["token"] in self.annotated)
        annotated = sorted((row for row in rows if row["token"] in self.annotated), key=lambda row: row["filename"])
        lost = len(self.annotated) - len(annotated)
        if lost:
            what = f"{lost} annotated image(s) have no row in it"
            self.faults.add("missing-row", f"{self.folder.name}/sample_data.json", what, _EXPORT)
        notes = []
        if len(rows) > len(annotated):
            what = f"{len(rows) - len(annotated)} key frame(s) have no annotation and are left out"
            remedy = "Nothing to do, unless they should have one"
            notes = [Problem("not-annotated", f"{self.folder.name}/sample_data.json", what, remedy, "warning")]
        return [annotated[i] for i in spread(len(annotated), images)], notes

    def classes(self, path: Path | None) -> tuple[Mapped, dict[str, int]]:
        """The classes, and category token → class for the categories that are used."""
        names = {token: self.categories[token] for token in self.used if token in self.categories}
        if path is None:
            known = {name: known_class(name) for name in names.values()}
            table = {n: NUSCENES_AND_SKY.names.index(c) for n, c in known.items() if c is not None}
            mapped = Mapped(NUSCENES_AND_SKY, table)
        else:
            mapped = read_classes(path)
        for name in sorted(set(names.values()) - mapped.index.keys()):
            remedy = "Name this category in the file of --classes, as a class or under 'void'"
            where = f"{self.folder.name}/category.json"
            self.faults.add("unknown-class", where, f"no class is known for the category {name!r}", remedy)
        return mapped, {token: mapped.index[name] for token, name in names.items() if name in mapped.index}

    def masks(self, wanted: set[str]) -> dict[str, list[_Drawn]]:
        """Image → its masks in the order of painting."""
        drawn: dict[str, list[_Drawn]] = {}
        for name, table in _MASKS.items():
            rows = self._rows(table, lambda row: row["sample_data_token"] in wanted)
            if name == "object_ann":
                rows.sort(key=lambda row: str(row["token"]))
            numbers: Counter[str] = Counter()
            for row in rows:
                image = row["sample_data_token"]
                numbers[image] += 1
                number = numbers[image] if name == "object_ann" else 0
                where = f"{self.folder.name}/{name}.json: {row['token']}"
                if row["mask"] is not None:
                    drawn.setdefault(image, []).append(_Drawn(where, row["category_token"], row["mask"], number))
        return drawn

    def _rows(self, table: Table, keep: Callable[[Row], bool] = lambda row: True) -> list[Row]:
        problems: list[Problem] = []
        rows = read_table(self.folder, table, problems, keep)
        self.faults.extend(problems)
        return rows

    def _unique(self, table: Table, keep: Callable[[Row], bool] = lambda row: True) -> list[Row]:
        problems: list[Problem] = []
        rows = unique(read_table(self.folder, table, problems, keep), f"{self.folder.name}/{table.name}.json", problems)
        self.faults.extend(problems)
        return list(rows.values())


def _truth(picture: Path, drawn: list[_Drawn], index: dict[str, int]) -> Truth:
    try:
        width, height = size_of(picture)
    except BadFile as error:
        raise Fault("bad-image", picture, str(error), "Copy the image again, or take out its annotations") from error
    semantic = np.zeros((height, width), np.uint8)
    instance = np.zeros((height, width), np.int32)
    for entry in drawn:
        mask = _mask(entry, (height, width))
        semantic[mask] = index[entry.category]
        instance[mask] = entry.instance
    return semantic, instance


def _mask(entry: _Drawn, size: tuple[int, int]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    try:
        mask = entry.mask
        if not isinstance(mask, dict) or not isinstance(mask.get("counts"), str):
            raise BadMask("its mask has no 'counts'")
        if mask.get("size") != list(size):
            raise BadMask(f"its mask is of size {mask.get('size')}, the image of [height, width] {list(size)}")
        return decode_base64(mask["counts"], size)
    except BadMask as error:
        raise Fault("bad-mask", Path(entry.where), str(error), _EXPORT) from error
