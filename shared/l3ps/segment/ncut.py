"""Objects of one class that touch, parted by recursive normalised cuts along a boundary map (METHOD 1).

Two pixels at most ``RADIUS`` apart are as alike as the line between them is free of boundary. A set of pixels is cut
in two where the likeness across is least beside that within (Shi and Malik 2000: second eigenvector of the normalised
Laplacian), and its parts again, until a cut costs too much.

The published rule has one unknown a pixel. Here it has one a cell: pixels are gathered around seeds of a grid, along
paths that cross as little boundary as they can, so that cells end where a cut may run. The likeness of two cells is
the sum over their pixels, hence the cost of any cut between cells is exactly the published one; only cuts through the
middle of a cell are not looked at, and those that cost little do not exist.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from threadpoolctl import ThreadpoolController

from l3ps.segment.panoptic import nearest

RADIUS = 5
"""Pixels of the affinity map."""
SHARPNESS = 70.0
"""Affinity of two pixels: exp(-70 × strongest boundary on the line between them)."""
MAX_COST = 0.002
"""No cut that costs more is made."""
MAX_SMOOTHNESS = 0.03
"""Nor one along an eigenvector that has no gap: least over fullest bin of its histogram."""
BINS = 20
"""Of that histogram; neither the paper nor METHOD.md has their number."""
MIN_EDGE, MAX_CELLS = 3, 300
"""Cells are squares of 3 pixels, or larger ones where a segment would have more cells, before they follow the lines.

Of the 202 objects that cuts pixel by pixel find in 175 segments of simulated and real images (boundaries with noise
and gaps), these cells find 179 again (IoU over 0.5), cells of 5 pixels 172. Those of 2 find 183, but take wide lines
for objects; 500 of them in place of 300 change nothing on larger segments and take half as long again.
"""
_FAR, _LENGTH, _UNITS = 14.0, 0.1, 20
"""A step of a cell's growth costs the logarithm of the pixel's affinity, up to 14 (one in a million), and a tenth for
its length, which makes cells compact; both in twentieths."""
_OUTSIDE, _UNREACHED = 1 << 28, 1 << 30
_APART = 1e-7
"""Cells less alike than this, as a share of their likeness to all, hang together by rounding alone."""


def offsets() -> list[tuple[int, int]]:
    """The half of the neighbourhood that follows a pixel in reading order: (rows, columns)."""
    reach = range(-RADIUS, RADIUS + 1)
    return [(y, x) for y in reach for x in reach if 0 < y * y + x * x <= RADIUS**2 and (y, x) > (0, 0)]


def line(rows: int, columns: int) -> list[tuple[int, int]]:
    """Pixels on the line from (0, 0) to an offset, both included."""
    steps = max(abs(rows), abs(columns))
    return [(round(rows * k / steps), round(columns * k / steps)) for k in range(steps + 1)]


def cut(strength: NDArray[np.float32], mask: NDArray[np.bool_], least: int = 0) -> NDArray[np.int32]:
    """Part a connected segment into objects.

    Args:
        strength: (h, w) how sure a boundary passes the pixel, 0 to 1.
        mask: (h, w) the segment.
        least: parts of fewer pixels are none: they return to the nearest that is larger, where there is one, so that
            the line of a cut costs no pixels.

    Returns:
        (h, w) number of the part, from 1 in reading order of the parts' first pixels; 0 outside the mask.
    """
    result = np.zeros(mask.shape, dtype=np.int32)
    if not mask.any():
        return result
    # The strongest boundary on a line has the least of the pixels' own affinities.
    free = np.exp(-SHARPNESS * strength)
    cells, number = _cells(free, mask)
    part = np.zeros(number + 1, dtype=np.int32)
    if number > 1:
        for k, members in enumerate(_parts(_affinity(free, cells, number), cells, least)):
            part[members + 1] = k
    result[mask] = part[cells[mask]] + 1
    _return_crumbs(result, least)
    found = result[mask]
    _, first, inverse = np.unique(found, return_index=True, return_inverse=True)
    result[mask] = np.argsort(np.argsort(first))[inverse] + 1
    return result


def _return_crumbs(parts: NDArray[np.int32], least: int) -> None:
    """Give the pixels of parts that are too small to the nearest part that is not, in place."""
    area = np.bincount(parts.ravel())
    small = area < least
    small[0] = False
    if not small.any() or not (~small[1:] & (area[1:] > 0)).any():
        return
    crumbs = small[parts]
    holes = np.nonzero(crumbs)
    parts[holes] = parts[nearest(((parts > 0) & ~crumbs).view(np.uint8), *holes)[0]]


def _cells(free: NDArray[np.float32], mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """(h, w) cell of each pixel, from 1, 0 outside the mask; and how many there are."""
    edge = max(MIN_EDGE, math.ceil(math.sqrt(np.count_nonzero(mask) / MAX_CELLS)))
    while len((seeds := _seeds(free, mask, edge))[0]) > 2 * MAX_CELLS:
        edge *= 2  # a web of thin lines
    # What a path costs lies above the number of the cell in one integer, so that a step is a sum and a minimum.
    bits = len(seeds[0]).bit_length()
    least = np.float32(math.exp(-_FAR))
    step = np.round((_LENGTH - np.log(np.maximum(free, least))) * _UNITS).astype(np.int32) << bits
    step[~mask] = _OUTSIDE
    key = np.full(mask.shape, _UNREACHED, dtype=np.int32)
    key[seeds] = np.arange(1, len(seeds[0]) + 1)
    ways = ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:]))
    ways += tuple((np.s_[:, to], np.s_[:, since]) for to, since in ways)  # type: ignore[assignment]
    before = np.empty_like(key)
    while not np.array_equal(key, before):
        np.copyto(before, key)
        for _ in range(edge):
            for to, since in ways:
                np.minimum(key[to], key[since] + step[to], out=key[to])
    return np.where(mask, key & ((1 << bits) - 1), 0).astype(np.int32), len(seeds[0])


def _seeds(free: NDArray[np.float32], mask: NDArray[np.bool_], edge: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the pixel with the least boundary in each square of a grid that holds any of the mask."""
    height, width = mask.shape
    blocks = np.full((-(-height // edge), edge, -(-width // edge), edge), -1, dtype=np.float32)
    np.copyto(blocks.reshape(blocks.shape[0] * edge, -1)[:height, :width], free, where=mask)
    of_block = blocks.swapaxes(1, 2).reshape(-1, edge * edge)
    best = of_block.argmax(axis=1)
    taken = np.flatnonzero(of_block[np.arange(len(best)), best] >= 0)
    down, right = np.divmod(taken, blocks.shape[2])
    return down * edge + best[taken] // edge, right * edge + best[taken] % edge


def _affinity(free: NDArray[np.float32], cells: NDArray[np.int32], number: int) -> NDArray[np.float64]:
    """(n, n) sum of the affinities of the pixels of two cells."""
    height, width = free.shape
    size = number + 1
    padded, cell = np.pad(free, RADIUS), np.pad(cells, RADIUS)
    row = cells * np.int32(size)
    same = np.zeros(free.shape, dtype=np.float32)
    total = np.zeros(size * size)
    least, other_cell = np.empty_like(free), np.empty(free.shape, dtype=bool)
    for rows, columns in offsets():
        np.copyto(least, free)
        for y, x in line(rows, columns)[1:]:
            top, left = RADIUS + y, RADIUS + x
            np.minimum(least, padded[top : top + height, left : left + width], out=least)
        other = cell[RADIUS + rows : RADIUS + rows + height, RADIUS + columns : RADIUS + columns + width]
        # Most pairs lie in one cell: those are summed in place, and only the others sorted by their cells.
        np.not_equal(cells, other, out=other_cell)
        np.add(same, least, out=same, where=~other_cell)
        pairs = np.flatnonzero(other_cell)
        codes = row.ravel()[pairs] + other[other_cell]
        total += np.bincount(codes, weights=least.ravel()[pairs], minlength=size * size)
    between = total.reshape(size, size)[1:, 1:]
    within = np.bincount(cells.ravel(), weights=same.ravel(), minlength=size)[1:]
    return np.asarray(between + between.T + np.diag(2 * within), dtype=np.float64)


@cache
def _blas() -> Any:
    """Hold on the numeric library's threads: on matrices this small they wait for one another more than they compute.

    Two images at a time on two cores took 1.1 s an image with them.
    """
    return ThreadpoolController()


@dataclass(frozen=True, slots=True)
class _Cut:
    """A two-way cut: its cost, one side, and the eigenvector it follows."""

    cost: float
    side: NDArray[np.bool_]
    vector: NDArray[np.float64]


def _parts(affinity: NDArray[np.float64], cells: NDArray[np.int32], least: int) -> list[NDArray[np.intp]]:
    """The cells of each object."""
    pixels = np.bincount(cells.ravel(), minlength=len(affinity) + 1)[1:]
    done: list[NDArray[np.intp]] = []
    todo = _apart(affinity, np.arange(len(affinity)))
    while todo:
        members = todo.pop()
        if len(members) < 2 or pixels[members].sum() < least:
            done.append(members)
            continue
        found = best_cut(affinity[np.ix_(members, members)])
        if found.cost > MAX_COST or _smooth(found.vector, pixels[members]):
            done.append(members)
            continue
        for side in (members[found.side], members[~found.side]):
            todo += _apart(affinity, side)
    return done


def _apart(affinity: NDArray[np.float64], members: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Sets of cells that hang together: between them a cut costs nothing, and there may be many as good."""
    inner = affinity[np.ix_(members, members)]
    degree = np.sqrt(inner.sum(axis=1))
    linked = inner > _APART * np.outer(degree, degree)
    left = np.ones(len(members), dtype=bool)
    groups = []
    while left.any():
        group = np.zeros_like(left)
        front = np.array([left.argmax()])
        while len(front):
            group[front] = True
            front = np.flatnonzero(linked[front].any(axis=0) & ~group)
        groups.append(members[group])
        left &= ~group
    return groups


def best_cut(affinity: NDArray[np.float64]) -> _Cut:
    """The cheapest cut along the second eigenvector.

    Args:
        affinity: (n, n) symmetric, n ≥ 2, every row with a positive sum.
    """
    degree = affinity.sum(axis=1)
    root = np.sqrt(degree)
    n = len(degree)
    with _blas().limit(limits=1, user_api="blas"):
        _, vectors = eigh(affinity / np.outer(root, root), subset_by_index=[n - 2, n - 2], check_finite=False)
    vector = vectors[:, 0] / root
    order = np.argsort(vector, kind="stable")
    ahead, behind = degree[order].cumsum()[:-1], degree[order][::-1].cumsum()[::-1][1:]
    # Across each place to cut at: what all before it share with all after it.
    across = np.triu(affinity[np.ix_(order, order)].cumsum(axis=0), 1).sum(axis=1)[:-1]
    cost = across * (1 / ahead + 1 / behind)
    best = int(cost.argmin())
    side = np.zeros(n, dtype=bool)
    side[order[: best + 1]] = True
    return _Cut(float(cost[best]), side, vector)


def _smooth(vector: NDArray[np.float64], pixels: NDArray[np.intp]) -> bool:
    """Whether the eigenvector has no gap to cut at."""
    bins, _ = np.histogram(vector, BINS, weights=pixels)
    return bool(bins.min() > MAX_SMOOTHNESS * bins.max())
