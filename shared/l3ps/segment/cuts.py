"""Fusion of a semantic map and a boundary map by normalised cuts (METHOD 1, the published mode)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.segment.ncut import cut
from l3ps.segment.panoptic import PanopticImage, Window, fill, nearest, thing_masks

MAP_SCALE = 5 / 14
"""Pixels of the affinity map to one of the camera image."""


def fuse_cuts(
    semantic: NDArray[np.uint8],
    size: tuple[int, int],
    inside: NDArray[np.float32],
    *,
    threshold: float = 0.98,
    min_area: float = 0.0,
) -> PanopticImage:
    """Split thing classes into objects where a boundary makes the cut cheap.

    Connected segments of a thing class are cut; parts that are too small, that touch no boundary, or that lie inside
    another thing are no objects, and their pixels take the label of the nearest that is left.

    Args:
        semantic: (h, w) uint8 ``NUSCENES16`` class.
        size: (width, height) of the camera image; decides the resolution of the cuts.
        inside: (h', w') float32, probability that a pixel lies inside an object, not on the line between two.
        threshold: below it a pixel counts as boundary for an object to touch.
        min_area: smallest object, as a share of the image's area.

    Returns:
        The panoptic image at the resolution of ``semantic``.
    """
    semantic = semantic.copy()
    instance = np.zeros(semantic.shape, dtype=np.int32)
    dropped = np.zeros(semantic.shape, dtype=np.uint8)
    strength, near = _boundary(inside, size, threshold)
    floor = min_area * semantic.size
    count = 0
    for window, segment in _segments(semantic, floor, dropped):
        rows, columns = (_Axis(*a) for a in zip(window, semantic.shape, strength.shape, strict=True))
        coarse = segment[np.ix_(rows.sampled, columns.sampled)]
        if not coarse.any():  # thinner than the map's pixels
            coarse = np.ones_like(coarse)
        view = rows.window, columns.window
        parts = cut(strength[view], coarse, int(min_area * strength.size))
        touching = np.zeros(int(parts.max()) + 1, dtype=bool)
        touching[parts[near[view] & coarse]] = True
        holes = np.nonzero(parts == 0)
        if len(holes[0]):
            parts[holes] = parts[nearest(coarse.view(np.uint8), *holes)[0]]
        fine = np.where(segment, parts[np.ix_(rows.own, columns.own)], 0)
        keep = touching & (np.bincount(fine.ravel(), minlength=len(touching)) >= max(floor, 1))
        keep[0] = False
        ids = np.zeros(len(keep), dtype=np.int32)
        ids[keep] = np.arange(count + 1, count + 1 + int(keep.sum()))
        count += int(keep.sum())
        found = ids[fine]
        instance[window] += found
        dropped[window] |= segment & (found == 0)
    fill(semantic, instance, dropped)
    within = _enclosed(instance, count)
    if within.any():
        fill(semantic, instance, within[instance].view(np.uint8))
    return PanopticImage(semantic, instance, size)


class _Axis:
    """Rows or columns of a window of the labels, and those of the affinity map that they meet.

    Attributes:
        window: the map's rows.
        sampled: of each of these, the window's row that lies in its middle.
        own: of each of the window's rows, that of the map's window.
    """

    def __init__(self, part: slice, length: int, coarse: int) -> None:
        rows = np.arange(part.start, part.stop)
        own = ((rows + 0.5) * (coarse / length)).astype(np.intp)
        self.window = slice(int(own[0]), int(own[-1]) + 1)
        middle = (np.arange(self.window.start, self.window.stop) + 0.5) * (length / coarse)
        self.sampled = np.clip(middle.astype(np.intp), part.start, part.stop - 1) - part.start
        self.own = own - own[0]


def _boundary(
    inside: NDArray[np.float32], size: tuple[int, int], threshold: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Boundary strength on the affinity map, and where a boundary is at most a pixel away."""
    target = (max(1, round(size[0] * MAP_SCALE)), max(1, round(size[1] * MAP_SCALE)))
    shrinks = target[0] < inside.shape[1]
    # Averaged where it shrinks: a line that is thinner than the map's pixels must not fall between them.
    coarse = cv2.resize(inside, target, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    strength = np.clip(1 - np.asarray(coarse, dtype=np.float32), 0, 1)
    passes = (strength > 1 - threshold).view(np.uint8)
    return strength, np.asarray(cv2.dilate(passes, np.ones((3, 3), np.uint8))).view(np.bool_)


def _segments(
    semantic: NDArray[np.uint8], floor: float, dropped: NDArray[np.uint8]
) -> Iterator[tuple[Window, NDArray[np.bool_]]]:
    """Connected segments of the thing classes: window and mask in it. Those that are too small go to ``dropped``."""
    for (down, right), of_class in thing_masks(semantic):
        _, labels, stats, _ = cv2.connectedComponentsWithStats(of_class, connectivity=8)
        small = stats[:, cv2.CC_STAT_AREA] < floor
        small[0] = False
        if small.any():
            dropped[down, right] |= small[labels]
        for k in np.flatnonzero(~small[1:]) + 1:
            x, y, width, height = stats[k, :4].tolist()
            mask = labels[y : y + height, x : x + width] == k
            top, left = down.start + y, right.start + x
            yield np.s_[top : top + height, left : left + width], np.asarray(mask, dtype=bool)


def _enclosed(instance: NDArray[np.int32], count: int) -> NDArray[np.bool_]:
    """(count + 1,) whether all that an object borders on is one other object."""
    pairs = []
    for one, other in ((instance[1:], instance[:-1]), (instance[:, 1:], instance[:, :-1])):
        at = one != other
        pairs += [(one[at], other[at]), (other[at], one[at])]
    edges = np.concatenate([instance[0], instance[-1], instance[:, 0], instance[:, -1]])
    pairs.append((edges, np.zeros_like(edges)))
    mine, theirs = (np.concatenate(side).astype(np.int64) for side in zip(*pairs, strict=True))
    mine, theirs = np.divmod(np.unique(mine * (count + 1) + theirs), count + 1)
    neighbours = np.bincount(mine, minlength=count + 1)
    lone = neighbours == 1
    lone[mine[theirs == 0]] = False
    lone[0] = False
    return np.asarray(lone, dtype=bool)
