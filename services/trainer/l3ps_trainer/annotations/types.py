"""What an annotated image is, whatever format it came in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from l3ps.errors import Problem
from l3ps.taxonomy import NUSCENES16

IGNORED = 0
"""Void: no loss, no score."""
LARGEST_INSTANCE = 2**24 - 1
"""Ids above would not survive the float32 arithmetic that finds the borders between them."""


@dataclass(frozen=True)
class Annotated:
    """One annotated image in memory.

    Attributes:
        rgb: (H, W, 3) uint8.
        semantic: (H, W) uint8 class, 0 void (not annotated).
        instance: (H, W) int32 id that names one object of the image, 0 for none; None where objects are not annotated.
    """

    rgb: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32] | None


@dataclass(frozen=True)
class ClassSet:
    """The classes of a set of annotated images.

    Attributes:
        names: by index; ``names[0]`` is ``void``.
        to_nuscenes: ``NUSCENES16`` class of each; 0 for what LiDAR labels do not know, such as the sky.
    """

    names: tuple[str, ...]
    to_nuscenes: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.names or self.names[0] != "void" or self.to_nuscenes[:1] != (0,):
            raise ValueError("class 0 must be 'void', mapped to 0")
        if len(self.names) != len(self.to_nuscenes) or len(set(self.names)) != len(self.names):
            raise ValueError("every class needs a name of its own and one class to map to")

    def __len__(self) -> int:
        return len(self.names)


NUSCENES_AND_SKY = ClassSet((*NUSCENES16.classes, "sky"), (*range(len(NUSCENES16.classes)), 0))
"""Void, the sixteen classes, sky: what the simulator draws, and what formats with many categories are folded into."""


@dataclass(frozen=True)
class AnnotatedImage:
    """An annotated image that is read when it is asked for.

    Attributes:
        name: of the image, relative to the annotations.
        read: reads it.
    """

    name: str
    read: Callable[[], Annotated] = field(repr=False, compare=False)

    def load(self) -> Annotated:
        """Decode image and annotation.

        Raises:
            AnnotationError: a file went away or is damaged behind its header.
        """
        return self.read()


@dataclass(frozen=True)
class AnnotationSet:
    """Annotated images of one source.

    Attributes:
        classes: what their pixels may be.
        images: in the order of their names.
        has_instances: whether objects are annotated, not only classes.
        pixels: (n, C) int64 pixels of each class in each image, where the reader has counted them.
        notes: what the user should know of the annotations; nothing of it stops the work.
    """

    classes: ClassSet
    images: tuple[AnnotatedImage, ...]
    has_instances: bool
    pixels: NDArray[np.int64] | None = field(default=None, repr=False, compare=False)
    notes: tuple[Problem, ...] = ()

    @classmethod
    def of(cls, classes: ClassSet, images: Sequence[Annotated]) -> AnnotationSet:
        """Images that are in memory already."""
        named = tuple(AnnotatedImage(f"{i:04d}", lambda image=image: image) for i, image in enumerate(images))  # type: ignore[misc]
        return cls(classes, named, all(image.instance is not None for image in images))

    def counts(self) -> NDArray[np.int64]:
        """(C,) int64 annotated pixels of each class; images are decoded when nobody has counted yet."""
        if self.pixels is not None:
            return np.asarray(self.pixels.sum(axis=0), dtype=np.int64)
        found = np.zeros(len(self.classes), np.int64)
        for image in self.images:
            found += np.bincount(image.load().semantic.ravel(), minlength=len(self.classes))
        return found

    def missing(self) -> tuple[str, ...]:
        """Names of the classes that never occur: a network cannot learn them from these images."""
        found = self.counts()
        return tuple(name for name, count in zip(self.classes.names[1:], found[1:], strict=True) if not count)

    def subset(self, positions: Sequence[int]) -> AnnotationSet:
        """The images at some positions, in the order given."""
        pixels = None if self.pixels is None else self.pixels[list(positions)]
        return replace(self, images=tuple(self.images[i] for i in positions), pixels=pixels)


def spread(count: int, wanted: int | None) -> list[int]:
    """Positions of ``wanted`` of ``count`` images, evenly spread over all of them; every one for None or too many.

    Neighbours by name are mostly neighbours in time, which show the same street.
    """
    if wanted is None or wanted >= count:
        return list(range(count))
    return [(2 * i + 1) * count // (2 * wanted) for i in range(wanted)]
