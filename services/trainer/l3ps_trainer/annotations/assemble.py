"""From files to a checked set: every annotation is looked at once before anything is made of it.

A reader of a format finds the files, says how one annotation is read, and leaves the rest to :func:`assembled`: sizes
by header, ids by the label maps themselves (pictures stay closed), and the pixels of each class on the way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from l3ps.errors import AnnotationError, Problem
from l3ps.progress import Progress, track

from .classes import Key, Mapped
from .faults import Faults
from .files import BadFile, read_picture, size_of
from .types import LARGEST_INSTANCE, Annotated, AnnotatedImage, AnnotationSet

Truth = tuple[NDArray[np.uint8], NDArray[np.int32] | None]
"""(H, W) uint8 class and (H, W) int32 instance or None."""


class Fault(Exception):  # noqa: N818  (a Problem on its way)
    """Something wrong with one annotation."""

    def __init__(self, code: str, path: Path, what: str, remedy: str) -> None:
        super().__init__(f"{path}: {what}. {remedy}")
        self.code, self.path, self.what, self.remedy = code, path, what, remedy


@dataclass(frozen=True)
class Item:
    """One annotated image before it is checked.

    Attributes:
        name: of the image.
        picture: its file.
        truth: reads its annotation; raises :class:`Fault`.
    """

    name: str
    picture: Path
    truth: Callable[[], Truth]


def assembled(
    items: Sequence[Item],
    mapped: Mapped,
    faults: Faults,
    progress: Progress,
    *,
    has_instances: bool,
    notes: Sequence[Problem] = (),
) -> AnnotationSet:
    """Check what a reader found and make a set of it.

    Args:
        items: the images.
        mapped: their classes.
        faults: found so far.
        progress: told the images looked at (stage ``annotations``); may raise to stop.
        has_instances: whether objects are annotated.
        notes: for the set.

    Raises:
        AnnotationError: with everything that is wrong, or when there is no image.
    """
    if not items and not faults:
        faults.add("no-annotations", faults.root.name, "it holds no annotated image", "Add images and their labels")
    count = len(mapped.classes)
    pixels = np.zeros((len(items), count), np.int64)
    for row, item in enumerate(track(items, "annotations", progress)):
        try:
            semantic, _ = _checked(item)
        except Fault as fault:
            faults.add(fault.code, fault.path, fault.what, fault.remedy)
        else:
            pixels[row] = np.bincount(semantic.ravel(), minlength=count)
    if not faults and not pixels[:, 1:].any():
        what = f"no pixel of its {len(items)} image(s) has a class; all are void"
        faults.add("nothing-annotated", faults.root.name, what, "Correct the classes file or the annotations")
    faults.stop()
    images = tuple(AnnotatedImage(item.name, _reader(item, faults.root)) for item in items)
    return AnnotationSet(mapped.classes, images, has_instances, pixels, tuple(notes))


def _checked(item: Item) -> Truth:
    """The truth of an image, of the image's size."""
    try:
        size = size_of(item.picture)
    except BadFile as error:
        raise Fault("bad-image", item.picture, str(error), "Copy the image again, or take out its labels") from error
    semantic, instance = item.truth()
    for kind, labels in (("class labels", semantic), ("instance labels", instance)):
        if labels is not None and labels.shape[::-1] != size:
            seen, wanted = (f"{w}x{h}" for w, h in (labels.shape[::-1], size))
            what = f"its {kind} have {seen} pixels, the image has {wanted}"
            raise Fault("wrong-label-size", item.picture, what, "Label the image at its own size")
    return semantic, instance


def _reader(item: Item, root: Path) -> Callable[[], Annotated]:
    def read() -> Annotated:
        where = item.picture
        try:
            semantic, instance = _checked(item)
            return Annotated(read_picture(item.picture), semantic, instance)
        except Fault as fault:
            where, code, what, remedy = fault.path, fault.code, fault.what, fault.remedy
        except BadFile as error:
            code, what, remedy = "bad-image", str(error), "Copy the image again, or take out its labels"
        raise AnnotationError(Problem(code, Faults(root).where(where), what, remedy))

    return read


def labels_of(path: Path, read: Callable[[Path], NDArray[Any]]) -> NDArray[Any]:
    """A label map, its faults as :class:`Fault`."""
    try:
        return read(path)
    except BadFile as error:
        raise Fault("bad-labels", path, str(error), "Write label maps as PNG or npy, one integer a pixel") from error


def to_classes(ids: NDArray[Any], index: Mapping[Key, int], path: Path, remedy: str) -> NDArray[np.uint8]:
    """Ids to classes.

    Args:
        ids: (H, W) integers.
        index: id → class.
        path: of the label map, for the fault.
        remedy: what to do about an id that is not known.

    Returns:
        (H, W) uint8.

    Raises:
        Fault: an id is not known.
    """
    values = _values(ids)
    unknown = [int(value) for value in values if int(value) not in index]
    if unknown:
        some = ", ".join(map(str, unknown[:8])) + (", …" if len(unknown) > 8 else "")
        pixels = int(np.isin(ids, unknown).sum())
        raise Fault("unknown-class", path, f"{pixels} pixel(s) have ids that no class has: {some}", remedy)
    lut = np.array([index[int(value)] for value in values], dtype=np.uint8)
    return np.asarray(lut[np.searchsorted(values, ids)], dtype=np.uint8)


def _values(ids: NDArray[Any]) -> NDArray[np.int64]:
    """The values that occur, sorted; counted where they are few, which is ten times faster than sorting pixels."""
    if ids.dtype.kind == "u" and ids.dtype.itemsize <= 2:
        return np.flatnonzero(np.bincount(ids.ravel()))
    return np.unique(ids).astype(np.int64)


def to_instances(ids: NDArray[Any], path: Path) -> NDArray[np.int32]:
    """Instance ids as (H, W) int32.

    Raises:
        Fault: negative or too large ones.
    """
    low, high = int(ids.min(initial=0)), int(ids.max(initial=0))
    if low < 0 or high > LARGEST_INSTANCE:
        what = f"its instance ids run from {low} to {high}, outside 0..{LARGEST_INSTANCE}"
        raise Fault("bad-instances", path, what, "Number the objects of an image from 1; 0 is none")
    return ids.astype(np.int32)
