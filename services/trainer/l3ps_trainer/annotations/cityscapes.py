"""Cityscapes' folders: ``leftImg8bit/`` beside ``gtFine/``, the label ids and instance ids as PNG.

Read are ``…_leftImg8bit.png`` with ``…_gtFine_labelIds.png`` and, where there are any, ``…_gtFine_instanceIds.png``,
in which an object is label id * 1000 + number and everything else its bare label id. Of a whole copy the split
``train`` is read; name ``leftImg8bit/val`` to read another one.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from l3ps.drivelog.names import is_hidden, subfolders
from l3ps.errors import Problem
from l3ps.progress import Progress

from .assemble import Fault, Item, Truth, assembled, labels_of, to_classes, to_instances
from .classes import Mapped, read_classes
from .faults import Faults
from .files import read_labels
from .names import CITYSCAPES, CITYSCAPES_IDS, CITYSCAPES_VOID
from .types import AnnotationSet, spread

LAYOUT: Final = "leftImg8bit/ with gtFine/ (Cityscapes)"
_IMAGE, _LABELS, _INSTANCES = "_leftImg8bit.png", "_gtFine_labelIds.png", "_gtFine_instanceIds.png"
_FACTOR: Final = 1000
_SPLIT: Final = "train"
_NAMES: Final = "Keep every image in leftImg8bit/ together with its labels at the same place in gtFine/"
_IDS: Final = "Use Cityscapes' label ids (not its training ids), or name the ids in the file of --classes"

CITYSCAPES_MAPPED: Final = Mapped(
    CITYSCAPES, dict.fromkeys(CITYSCAPES_VOID, 0) | {i: n for n, i in enumerate(CITYSCAPES_IDS, start=1)}
)


def is_cityscapes(folder: Path) -> bool:
    """Whether a folder has this layout, or is a split of one that has."""
    return _root(folder) is not None


def read_cityscapes(folder: Path, classes: Path | None, images: int | None, progress: Progress) -> AnnotationSet:
    """Read Cityscapes-style annotations.

    Args:
        folder: that holds ``leftImg8bit`` and ``gtFine``, or one split, ``leftImg8bit/NAME``.
        classes: classes file for other label ids; None takes the nineteen training classes.
        images: read so many, spread evenly; None reads all.
        progress: told the images looked at.

    Raises:
        AnnotationError: with everything that is wrong.
    """
    root = _root(folder)
    assert root is not None
    mapped = read_classes(classes) if classes else CITYSCAPES_MAPPED
    faults = Faults(root)
    split, notes = _split(root, folder)
    pictures, labels, instances = (
        _files(root / kind / split, ending)
        for kind, ending in (("leftImg8bit", _IMAGE), ("gtFine", _LABELS), ("gtFine", _INSTANCES))
    )
    lacking = [(pictures, labels, _LABELS), (labels, pictures, _IMAGE)]
    if instances:
        lacking += [(labels, instances, _INSTANCES), (instances, labels, _LABELS)]
    for found, needed, ending in lacking:
        for stem in sorted(found.keys() - needed.keys()):
            faults.add("missing-counterpart", found[stem], f"there is no {stem.name}{ending} to it", _NAMES)
    faults.stop()
    stems = sorted(pictures)
    items = [
        Item(str(stem), pictures[stem], partial(_truth, labels[stem], instances.get(stem), mapped))
        for stem in (stems[i] for i in spread(len(stems), images))
    ]
    return assembled(items, mapped, faults, progress, has_instances=bool(instances), notes=notes)


def _root(folder: Path) -> Path | None:
    """The folder that holds both trees."""
    for root in (folder, folder.parent.parent):
        here = (root / "leftImg8bit").is_dir() and (root / "gtFine").is_dir()
        if here and folder in (root, root / "leftImg8bit" / folder.name):
            return root
    return None


def _split(root: Path, folder: Path) -> tuple[str, list[Problem]]:
    """The split to read ("" for all there is), and what is said about the others."""
    if folder != root:
        return folder.name, []
    splits = [p.name for p in subfolders(root / "leftImg8bit")]
    if _SPLIT not in splits or len(splits) == 1:
        return "", []
    others = ", ".join(name for name in splits if name != _SPLIT)
    what = f"only the split {_SPLIT} is read, not {others}"
    return _SPLIT, [Problem("other-splits", "leftImg8bit", what, "Name leftImg8bit/SPLIT for another", "warning")]


def _files(folder: Path, ending: str) -> dict[Path, Path]:
    """Place and stem of each image → its file."""
    found = (p for p in folder.rglob(f"*{ending}") if not is_hidden(p))
    return {p.relative_to(folder).with_name(p.name.removesuffix(ending)): p for p in found}


def _truth(labels: Path, instances: Path | None, mapped: Mapped) -> Truth:
    ids = labels_of(labels, read_labels)
    semantic = to_classes(ids, mapped.index, labels, _IDS)
    if instances is None:
        return semantic, None
    packed = to_instances(labels_of(instances, read_labels), instances)
    if packed.shape == ids.shape:
        wrong = int((np.where(packed >= _FACTOR, packed // _FACTOR, packed) != ids).sum())
        if wrong:
            what = f"{wrong} pixel(s) belong to another class than in {labels.name}"
            raise Fault(
                "bad-instances", instances, what, "Write label id * 1000 + number for objects, else the label id"
            )
    return semantic, np.where(packed >= _FACTOR, packed, 0).astype(np.int32)
