"""Fusion of a semantic map and a boundary map into panoptic segments (METHOD 1, the cheaper mode).

Things are the connected components of each thing class, cut along the boundary map where there is one; a cut pixel
returns to its nearest component. Segments below a minimum area are no objects: their pixels take the nearest
remaining label.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.segment.scores import ClassScores
from l3ps.taxonomy import NUSCENES16, VOID


@dataclass(frozen=True, slots=True)
class PanopticImage:
    """Panoptic labels of one image at the resolution of the network's output.

    Attributes:
        semantic: (h, w) uint8 ``NUSCENES16`` class.
        instance: (h, w) int32 id, 0 = none; ids run from 1 and name one segment of this image.
        size: (width, height) in pixels of the camera image that (h, w) covers.
        scores: what the network thought of every pixel, or None where nobody kept it.
    """

    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    size: tuple[int, int]
    scores: ClassScores | None = None


def fuse(
    semantic: NDArray[np.uint8],
    size: tuple[int, int],
    *,
    interior: NDArray[np.bool_] | None = None,
    min_area: float = 0.0,
) -> PanopticImage:
    """Split thing classes into objects.

    Args:
        semantic: (h, w) uint8 ``NUSCENES16`` class.
        size: (width, height) of the camera image.
        interior: (h, w) bool, False on the line between two objects; None where the bundle has no boundary head.
        min_area: smallest object, as a share of the image's area.

    Returns:
        The panoptic image at the resolution of ``semantic``.
    """
    semantic = semantic.copy()
    instance = np.zeros(semantic.shape, dtype=np.int32)
    floor = min_area * semantic.size
    dropped = np.zeros(semantic.shape, dtype=bool)
    count = 0
    for thing in sorted(NUSCENES16.things):
        of_class = semantic == thing
        if not of_class.any():
            continue
        core = of_class if interior is None else of_class & interior
        number, labels, stats, _ = cv2.connectedComponentsWithStats(core.astype(np.uint8), connectivity=8)
        if interior is not None:
            labels = np.where(of_class, _grow(labels, of_class), 0)
            area = np.bincount(labels.ravel(), minlength=number)[1:number]
        else:
            area = stats[1:, cv2.CC_STAT_AREA]
        ids = np.zeros(number, dtype=np.int32)
        keep = area >= floor
        ids[1:][keep] = np.arange(count + 1, count + 1 + int(keep.sum()))
        count += int(keep.sum())
        found = ids[labels]
        instance += found
        dropped |= of_class & (found == 0)
    if dropped.any():
        semantic, instance = _fill(semantic, instance, dropped)
    return PanopticImage(semantic, instance, size)


def _grow(labels: NDArray[np.int32], of_class: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Give each pixel of the class the label of the nearest component, so that a cut costs no pixels.

    A blob of the class without any core pixel stays without a component: it touches no interior at all.
    """
    if not labels.any():
        return labels
    _, blobs = cv2.connectedComponents(of_class.astype(np.uint8), connectivity=8)
    with_core = np.zeros(int(blobs.max()) + 1, dtype=bool)
    with_core[blobs[labels > 0]] = True
    return np.where(with_core[blobs], labels.ravel()[_nearest(labels > 0)], 0)


def _fill(
    semantic: NDArray[np.uint8], instance: NDArray[np.int32], holes: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Give the pixels of dropped segments the label of the nearest labelled pixel."""
    if holes.all():
        return np.full_like(semantic, VOID), np.zeros_like(instance)
    source = _nearest(~holes)
    return semantic.ravel()[source], instance.ravel()[source]


def _nearest(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(h, w) flat index of the nearest True pixel of a mask that has one (distance transform, OpenCV)."""
    _, label = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    where = np.zeros(int(label.max()) + 1, dtype=np.intp)
    flat = np.flatnonzero(mask)
    where[label.ravel()[flat]] = flat
    return np.asarray(where[label], dtype=np.intp)
