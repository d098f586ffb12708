"""How well two scans lie on each other under a motion: distances between what stands on the ground.

Every motion over flat ground leaves the ground on itself, so only points that stand above it are compared. A distance
from point to point cannot fall below the gap between two rings (0.12 to 0.24 m in the median on the recordings at
hand); what it tells is the difference between two motions of the same pair, and whether one is wrong altogether.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from l3ps.geometry import Matrix, apply

NEAREST, FURTHEST = 3.0, 45.0
"""Metres from the sensor: nearer is the vehicle itself, further the rings lie too far apart."""
SAMPLE = 20_000
"""Points of a scan that are looked at."""
COLUMN = 1.0
"""Metres; the ground is looked for in columns of this edge."""
TALL, ABOVE = 0.5, 0.3
"""Metres: something stands in a column this tall; what is this far above its foot belongs to it."""
CELL = 0.5
"""Metres; one point of each cell is a query, so that near objects with many points do not decide alone."""
QUERIES, TARGETS = 1000, 8000
ENOUGH = 50
"""Queries, below which a figure would be chance (an open field)."""
NEAR = 0.3
"""Metres within which a query counts as met."""
FAR = 2.0
"""Metres; larger distances count as this."""
SEARCH_REACH, SEARCH_QUERIES = 15, 150
"""Metres a LiDAR moves at most from one scan to the next (2 Hz at 108 km/h), and queries to each place tried."""

_OFFSET, _BITS = 1 << 10, 11


@dataclass(frozen=True, slots=True)
class Standing:
    """What stands on the ground in one scan.

    Attributes:
        queries: (Q, 3) float32, metres, lidar frame: spread evenly over what stands.
        tree: over points that stand, metres, lidar frame; None where there are none.
    """

    queries: NDArray[np.float32]
    tree: cKDTree | None


@dataclass(frozen=True, slots=True)
class Fit:
    """How two scans lie on each other; both figures are NaN where too little stands on the ground to tell.

    Attributes:
        residual: median distance in metres from a point of the one to the nearest of the other.
        overlap: share of the points with one nearer than ``NEAR``.
    """

    residual: float = float("nan")
    overlap: float = float("nan")


def standing(xyz: NDArray[np.float32]) -> Standing:
    """What stands on the ground in a scan.

    Args:
        xyz: (N, 3) float32, metres, lidar frame, z up; rows that are not finite are left out.
    """
    sample = xyz[:: max(1, len(xyz) // SAMPLE)]
    reach = np.einsum("ij,ij->i", sample, sample)
    points = sample[(reach > NEAREST**2) & (reach < FURTHEST**2)]  # neither holds for NaN
    if len(points) == 0:
        return Standing(points, None)
    column = _cells(points[:, :2], COLUMN)
    order = np.argsort(column)
    points, column = points[order], column[order]
    first = np.flatnonzero(np.r_[True, column[1:] != column[:-1]])
    foot, top = np.minimum.reduceat(points[:, 2], first), np.maximum.reduceat(points[:, 2], first)
    count = np.diff(np.r_[first, len(points)])
    stands = np.repeat(top - foot > TALL, count) & (points[:, 2] > np.repeat(foot + ABOVE, count))
    points = points[stands]
    if len(points) == 0:
        return Standing(points, None)
    _, one_each = np.unique(_cells(points, CELL), return_index=True)
    queries = points[one_each]
    targets = points[:: -(-len(points) // TARGETS)]
    tree = cKDTree(targets, balanced_tree=False, compact_nodes=False)  # built in a third of the time
    return Standing(queries[:: -(-len(queries) // QUERIES)], tree)


def fit(one: Standing, other: Standing, motion: Matrix) -> Fit:
    """How what stands in ``other`` lies on what stands in ``one``.

    Args:
        one: of a scan.
        other: of another.
        motion: (4, 4) transform from the other's lidar frame to that of ``one``.
    """
    if one.tree is None or len(other.queries) < ENOUGH:
        return Fit()
    distance, _ = one.tree.query(apply(motion, other.queries), distance_upper_bound=FAR)
    return Fit(float(np.median(np.minimum(distance, FAR))), float((distance < NEAR).mean()))


def search(one: Standing, other: Standing, candidates: Sequence[Matrix]) -> Matrix:
    """The best of some motions and of shifts in the plane without a turn, on a grid of one metre.

    Takes 0.1 s: for the few scans whose motion nothing tells.

    Args:
        one: of a scan.
        other: of the next.
        candidates: (4, 4) each.
    """
    if one.tree is None or len(other.queries) < ENOUGH:
        return candidates[0]
    few = other.queries[:: -(-len(other.queries) // SEARCH_QUERIES)]
    shifts = np.arange(-SEARCH_REACH, SEARCH_REACH + 1)
    grid = np.stack([*np.meshgrid(shifts, shifts, indexing="ij"), np.zeros((len(shifts),) * 2)], axis=-1).reshape(-1, 3)
    distance, _ = one.tree.query(few[None] + grid[:, None], distance_upper_bound=COLUMN, workers=1)
    shift = np.eye(4)
    shift[:3, 3] = grid[np.minimum(distance, COLUMN).mean(axis=1).argmin()]
    motions = [*candidates, shift]
    overlaps = [fit(one, other, motion).overlap for motion in motions]
    return motions[int(np.argmax(overlaps))]


def _cells(points: NDArray[np.float32], edge: float) -> NDArray[np.int64]:
    """(N,) int64 cell of each point (N, 2 or 3) within ``FURTHEST`` of the origin."""
    index = np.floor(points / edge).astype(np.int64) + _OFFSET
    key: NDArray[np.int64] = index[:, 0]
    for axis in range(1, points.shape[1]):
        key = (key << _BITS) | index[:, axis]
    return key
