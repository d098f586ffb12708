"""Fusion of a semantic map and a boundary map into panoptic segments (METHOD 1, the cheaper mode).

Things are the connected components of each thing class, cut along the boundary map where there is one; a cut pixel
returns to its nearest component. Segments below a minimum area are no objects: their pixels take the nearest
remaining label.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.segment.scores import ClassScores
from l3ps.taxonomy import NUSCENES16, VOID

Window = tuple[slice, slice]
"""Rows and columns of a part of an image."""


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
    dropped = np.zeros(semantic.shape, dtype=np.uint8)
    count = 0
    for window, of_class in thing_masks(semantic):
        core = of_class if interior is None else of_class & interior[window].view(np.uint8)
        number, components = cv2.connectedComponents(core, connectivity=8)
        labels = np.asarray(components, dtype=np.int32)
        area = np.bincount(labels[core.view(bool)], minlength=number)[1:]  # a third of what OpenCV's areas cost
        if interior is not None:
            area += _grow(labels, number, of_class ^ core, of_class)
        keep = area >= floor
        ids = np.zeros(number, dtype=np.int32)
        ids[1:][keep] = np.arange(count + 1, count + 1 + int(keep.sum()))
        count += int(keep.sum())
        found = ids[labels]
        instance[window] += found
        dropped[window] |= of_class & (found == 0)
    fill(semantic, instance, dropped)
    return PanopticImage(semantic, instance, size)


def thing_masks(semantic: NDArray[np.uint8]) -> Iterator[tuple[Window, NDArray[np.uint8]]]:
    """Each thing class of an image that occurs in it: the window that holds it, and where it is there (0 or 1)."""
    present = cv2.calcHist([semantic], [0], None, [256], [0, 256]).ravel() > 0
    for thing in sorted(NUSCENES16.things):
        if present[thing]:
            mask = cv2.inRange(semantic, thing, thing)
            x, y, width, height = cv2.boundingRect(mask)
            # OpenCV numbers components by blocks of 2×2 pixels: from even corners the numbers are the whole image's.
            window = np.s_[y - y % 2 : y + height, x - x % 2 : x + width]
            yield window, np.asarray(mask, dtype=np.uint8)[window] & np.uint8(1)


def fill(semantic: NDArray[np.uint8], instance: NDArray[np.int32], holes: NDArray[np.uint8]) -> None:
    """Give the pixels of dropped segments the label of the nearest pixel that has one, in place.

    Args:
        semantic: (h, w) class.
        instance: (h, w) id.
        holes: (h, w) 1 where the label is to be replaced. Where all are, the image becomes void.
    """
    number = cv2.countNonZero(holes)
    if number == holes.size:
        semantic[:], instance[:] = VOID, 0
    if number in {0, holes.size}:
        return
    # The nearest labelled pixel touches the hole.
    x, y, width, height = cv2.boundingRect(holes)
    around, _ = _widened(np.s_[y : y + height, x : x + width], 1, holes.shape)
    semantic, instance, holes = semantic[around], instance[around], holes[around]
    for box, member in _windows(*_blobs(holes)):
        window, inner = _widened(box, 1, holes.shape)
        rows, columns = np.nonzero(member)
        rows, columns = rows + inner[0], columns + inner[1]
        source, _ = nearest(holes[window] ^ np.uint8(1), rows, columns)
        semantic[window][rows, columns] = semantic[window][source]
        instance[window][rows, columns] = instance[window][source]


def _grow(
    labels: NDArray[np.int32], number: int, cut: NDArray[np.uint8], of_class: NDArray[np.uint8]
) -> NDArray[np.intp]:
    """Give each cut pixel the label of the nearest component, in place, so that a cut costs no pixels.

    A blob of the class without any core pixel stays without a component: it touches no interior at all.

    Args:
        labels: (h, w) component of each core pixel, else 0.
        number: components, the background included.
        cut: (h, w) 1 at pixels of the class that are not core.
        of_class: (h, w) 1 at pixels of the class.

    Returns:
        (number - 1,) pixels that each component gained.
    """
    gained = np.zeros(number, dtype=np.intp)
    if number == 1 or not cut.any():
        return gained[1:]
    core = of_class ^ cut
    blobs, boxes = _blobs(of_class)
    with_core = np.zeros(len(boxes) + 1, dtype=bool)
    with_core[blobs[core.view(bool)]] = True
    wanted = cut.view(bool) & with_core[blobs]
    for box, member in _windows(blobs, boxes):
        rows, columns = np.nonzero(wanted[box] & member)
        if not len(rows):
            continue
        source, distance = nearest(core[box], rows, columns)
        view = labels[box]
        # Another blob's core may be nearer than the own blob's.
        window, inner = _widened(box, int(distance.max()), core.shape)
        if cv2.countNonZero(core[window]) > cv2.countNonZero(core[box]):
            rows, columns = rows + inner[0], columns + inner[1]
            source, _ = nearest(core[window], rows, columns)
            view = labels[window]
        found = view[source]
        view[rows, columns] = found
        gained += np.bincount(found, minlength=number)
    return gained[1:]


def _blobs(mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(h, w) number of each connected part of a mask, from 1, and (parts, 4) their boxes: x, y, width, height."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    return np.asarray(labels, dtype=np.int32), np.asarray(stats[1:, :4], dtype=np.int32)


def _windows(blobs: NDArray[np.int32], boxes: NDArray[np.int32]) -> Iterator[tuple[Window, NDArray[np.bool_]]]:
    """The window of each blob and the blob's pixels in it; all blobs as one where that is the less to look at."""
    if len(boxes) > 500 or (boxes[:, 2] * boxes[:, 3]).sum() > blobs.size:
        yield np.s_[0 : blobs.shape[0], 0 : blobs.shape[1]], blobs > 0
        return
    for k, (x, y, width, height) in enumerate(boxes.tolist(), 1):
        box = np.s_[y : y + height, x : x + width]
        yield box, blobs[box] == k


def _widened(box: Window, margin: int, shape: tuple[int, ...]) -> tuple[Window, tuple[int, int]]:
    """A window with a margin, cut at the image's edge, and where in it the old one begins (row, column)."""
    rows, columns = (
        slice(max(0, side.start - margin), min(length, side.stop + margin))
        for side, length in zip(box, shape, strict=True)
    )
    return (rows, columns), (box[0].start - rows.start, box[1].start - columns.start)


def nearest(
    mask: NDArray[np.uint8], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], NDArray[np.float32]]:
    """The nearest pixel of a mask, as rows and columns, to each of some pixels, and how far it is (OpenCV)."""
    distance, label = cv2.distanceTransformWithLabels(
        np.ascontiguousarray(mask ^ 1), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # OpenCV numbers the mask's pixels from 1 in their order.
    of_mask = np.flatnonzero(mask)[label[rows, columns] - 1]
    rows_of, columns_of = np.divmod(of_mask, mask.shape[1])
    return (rows_of, columns_of), np.asarray(distance, dtype=np.float32)[rows, columns]
