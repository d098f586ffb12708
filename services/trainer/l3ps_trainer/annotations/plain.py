"""The plain folder: ``images/``, ``semantic/`` and, where objects are annotated, ``instance/``.

Files of one image have the same name. Images are PNG, JPEG or npy; label maps are PNG or npy with one integer a pixel:
in ``semantic/`` the id of the class, in ``instance/`` a number that names one object of the image, 0 for none. What
the ids mean stands in ``classes.json`` (:mod:`~.classes`); without it 0 is void, 1–16 are the classes of Panoptic
nuScenes and 17 is sky.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

from l3ps.progress import Progress

from .assemble import Item, Truth, assembled, labels_of, to_classes, to_instances
from .classes import NUSCENES_IDS, Mapped, read_classes
from .faults import Faults
from .files import LABELS, PICTURES, by_stem, read_labels
from .types import AnnotationSet, spread

LAYOUT: Final = "images/ with semantic/ (plain folder)"
CLASSES: Final = "classes.json"
_NAMES: Final = "Give the files of one image the same name in every folder, or take the others out"
_IDS: Final = f"Name these ids in {CLASSES} or the file of --classes, as classes or under 'void'"


def is_plain(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "images").is_dir() and (folder / "semantic").is_dir()


def read_plain(folder: Path, classes: Path | None, images: int | None, progress: Progress) -> AnnotationSet:
    """Read a plain folder.

    Args:
        folder: that holds the folders.
        classes: classes file; None takes the folder's own, or the classes of nuScenes.
        images: read so many, spread evenly; None reads all.
        progress: told the images looked at.

    Raises:
        AnnotationError: with everything that is wrong.
    """
    own = folder / CLASSES
    mapped = read_classes(classes) if classes else read_classes(own) if own.is_file() else NUSCENES_IDS
    faults = Faults(folder)
    for needed in ("images", "semantic"):
        if not (folder / needed).is_dir():
            faults.add("missing-folder", needed, "the folder is missing", "Add it, with one file an image")
    faults.stop()
    kinds = {"images": PICTURES, "semantic": LABELS}
    if (folder / "instance").is_dir():
        kinds["instance"] = LABELS
    files = {}
    for kind, endings in kinds.items():
        files[kind], others = by_stem(folder / kind, endings)
        for path, what in others:
            faults.add("unexpected-file", path, what, "Take it out of the folder")
    stems = sorted(set().union(*files.values()))
    for stem in stems:
        here = [found[stem] for found in files.values() if stem in found]
        for kind, found in files.items():
            if stem not in found:
                faults.add("missing-counterpart", here[0], f"there is no file of this name in {kind}/", _NAMES)
    faults.stop()
    chosen = [stems[i] for i in spread(len(stems), images)]
    instances = files.get("instance", {})
    items = [
        Item(stem, files["images"][stem], partial(_truth, files["semantic"][stem], instances.get(stem), mapped))
        for stem in chosen
    ]
    return assembled(items, mapped, faults, progress, has_instances="instance" in files)


def _truth(semantic: Path, instance: Path | None, mapped: Mapped) -> Truth:
    classes = to_classes(labels_of(semantic, read_labels), mapped.index, semantic, _IDS)
    return classes, None if instance is None else to_instances(labels_of(instance, read_labels), instance)
