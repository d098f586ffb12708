"""Thing points as occupied cells of the bird's-eye view, and what is measured on sets of them.

A scene has a hundred thousand thing points on a few thousand such cells; everything that finds objects works on cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import l3ps_cluster
from l3ps.refine.kinds import CLASSES, KIND_OF, KINDS
from l3ps.taxonomy import NUSCENES16, VOID

_CELLS_A_GAP = 4
"""Linking cells is linking points to a quarter of the gap."""
_REFINED = 0.2
"""Votes that a point's refined class adds to the one of its primal class."""
_GROUND_CELL = 4.0
"""Metres of road that have one height."""
_TOP = 0.9
"""Share of an object's cells that lie below its top: a few hold points of the tree above it."""
_ANGLES = np.radians(np.arange(0.0, 90.0, 7.5))
_AXES = np.concatenate(
    [np.stack([np.cos(_ANGLES), np.sin(_ANGLES)]), np.stack([-np.sin(_ANGLES), np.cos(_ANGLES)])], axis=1
)


@dataclass(frozen=True, slots=True)
class Spots:
    """Occupied cells, those of two scans or two kinds being different ones.

    Attributes:
        member: (M,) index of each thing point among the scene's points.
        of: (M,) its cell.
        xy: (K, 2) mean of each cell's points, metres, scene frame.
        scan: (K,) scan.
        kind: (K,) index into :data:`l3ps.refine.kinds.KINDS`.
        height: (K,) its highest point above the ground, metres.
        count: (K,) points.
        distance: (K,) metres from the sensor.
        bearing: (K, 2) unit vector from the sensor.
        votes: (K, 17) votes of its points.
    """

    member: NDArray[np.intp]
    of: NDArray[np.intp]
    xy: NDArray[np.float64]
    scan: NDArray[np.intp]
    kind: NDArray[np.intp]
    height: NDArray[np.float64]
    count: NDArray[np.float64]
    distance: NDArray[np.float64]
    bearing: NDArray[np.float64]
    votes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.xy)


def find_spots(
    points: NDArray[np.float32],
    bounds: NDArray[np.integer],
    floor: NDArray[np.float32],
    semantic: NDArray[np.uint8],
    primal: NDArray[np.uint8],
    origins: NDArray[np.float64],
) -> Spots:
    """The cells that a scene's thing points occupy.

    Args:
        points: (N, 3) float32, metres, scene frame, z up: all points or the things alone.
        bounds: (S + 1,) where each scan begins among the points, and N.
        floor: (G, 3) float32 points of the ground, metres, scene frame.
        semantic: (N,) uint8 refined class.
        primal: (N,) uint8 class before the vote.
        origins: (S, 3) the sensor's place at each scan, scene frame.
    """
    member = np.flatnonzero(NUSCENES16.is_thing[semantic])
    member = member[np.isfinite(points[member]).all(axis=1)]
    of = np.empty(len(member), dtype=np.intp)
    parts, number = [_scan_spots(points[:0], semantic[:0], primal[:0])[1]], 0
    scan = [np.zeros(0, dtype=np.intp)]
    # A scan at a time: the cells are few, but what it takes to find them is 100 bytes a point.
    for index, (first, stop) in enumerate(pairwise(np.searchsorted(member, bounds))):
        own = member[first:stop]
        found, part = _scan_spots(points[own], semantic[own], primal[own])
        of[first:stop] = number + found
        number += len(part.xy)
        parts.append(part)
        scan.append(np.full(len(part.xy), index, dtype=np.intp))
    xy, kind, highest, count, votes = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    of_scan = np.concatenate(scan)
    away = xy - origins[of_scan, :2] if number else xy
    distance = np.linalg.norm(away, axis=1)
    return Spots(
        member,
        of,
        xy,
        of_scan,
        kind,
        highest - _ground_height(floor, xy),
        count,
        distance,
        away / np.maximum(distance, 1e-9)[:, None],
        votes,
    )


class _ScanSpots(NamedTuple):
    """The cells of one scan; see :class:`Spots`, but ``highest`` is a height in the scene frame."""

    xy: NDArray[np.float64]
    kind: NDArray[np.intp]
    highest: NDArray[np.float64]
    points: NDArray[np.float64]
    votes: NDArray[np.float64]


def _scan_spots(
    points: NDArray[np.float32], semantic: NDArray[np.uint8], primal: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], _ScanSpots]:
    """(T,) cell of each thing point of a scan, and the cells."""
    kind_of = KIND_OF[semantic]
    own = points[:, :2].astype(np.float64)
    edge = np.array([kind.gap for kind in KINDS])[kind_of] / _CELLS_A_GAP
    of, count = _cells(own / edge[:, None], kind_of)
    number = len(count)
    xy = np.stack([np.bincount(of, weights=own[:, axis], minlength=number) for axis in (0, 1)], axis=1) / count[:, None]
    kind = np.zeros(number, dtype=np.intp)
    kind[of] = kind_of
    first = np.where(NUSCENES16.is_thing[primal], primal, VOID)
    votes = np.bincount(of * CLASSES + first, minlength=number * CLASSES) + _REFINED * np.bincount(
        of * CLASSES + semantic, minlength=number * CLASSES
    )
    highest = np.full(number, -np.inf)
    np.maximum.at(highest, of, points[:, 2])
    return of, _ScanSpots(xy, kind, highest, count.astype(np.float64), votes.reshape(number, CLASSES))


def linked(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """(K,) number of each point's component in the graph of all pairs within a distance of 1."""
    return l3ps_cluster.link(points, 1.0, threads=1).astype(np.intp)


def grouped(label: NDArray[np.integer], number: int) -> NDArray[np.intp]:
    """(K,) order in which labels below ``number`` ascend, equal ones as they come.

    Sorting by 16 bits is one pass over the labels where sorting by 64 is many.
    """
    order = np.argsort((label & 0xFFFF).astype(np.uint16), kind="stable")
    if number > 1 << 16:
        order = order[np.argsort((label[order] >> 16).astype(np.uint16), kind="stable")]
    return np.asarray(order)


def compact(label: NDArray[np.integer]) -> NDArray[np.intp]:
    """Labels numbered from 0 without holes, in their order."""
    return np.asarray(np.unique(label, return_inverse=True)[1], dtype=np.intp)


def extents(xy: NDArray[np.float64], label: NDArray[np.integer], number: int) -> NDArray[np.float64]:
    """(number, 2, 24) least and largest coordinate of each set along 24 axes; sets must not be empty.

    The extents of a union are the least and largest of its parts'.
    """
    order = grouped(label, number)
    first = np.searchsorted(label[order], np.arange(number))
    along = xy[order] @ _AXES
    return np.stack([np.minimum.reduceat(along, first), np.maximum.reduceat(along, first)], axis=1)


def rectangle(extent: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length and width (K,) in metres of the smallest rectangle at a step of 7.5° around (K, 2, 24) extents."""
    sides = extent[:, 1] - extent[:, 0]
    one, other = sides[:, : len(_ANGLES)], sides[:, len(_ANGLES) :]
    rows, best = np.arange(len(sides)), ((one + 0.1) * (other + 0.1)).argmin(axis=1)
    one, other = one[rows, best], other[rows, best]
    return np.maximum(one, other), np.minimum(one, other)


def total_votes(votes: NDArray[np.float64], label: NDArray[np.integer], number: int) -> NDArray[np.float64]:
    """(number, 17) votes of each set of cells."""
    return np.stack([np.bincount(label, weights=votes[:, c], minlength=number) for c in range(CLASSES)], axis=1)


def top(height: NDArray[np.floating], label: NDArray[np.integer], number: int) -> NDArray[np.floating]:
    """(number,) height that few of a set's cells exceed; sets must not be empty."""
    return quantile(height, label, number, _TOP)


def quantile(
    values: NDArray[np.floating], label: NDArray[np.integer], number: int, share: float
) -> NDArray[np.floating]:
    """(number,) value below which that share of each set lies; sets must not be empty."""
    order = np.argsort(values)
    order = order[grouped(label[order], number)]
    count = np.bincount(label, minlength=number)
    first = np.cumsum(count) - count
    return np.asarray(values[order[first + np.floor(share * (count - 1) + 0.5).astype(np.intp)]])


def _cells(xy: NDArray[np.float64], group: NDArray[np.integer]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Unit cell of each point and points of each cell; points of two groups share none."""
    if len(xy) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    key = np.floor(xy - np.floor(xy.min(axis=0))).astype(np.int64)
    wide = key.max(axis=0) + 1
    flat = (group.astype(np.int64) * wide[0] + key[:, 0]) * wide[1] + key[:, 1]
    _, of, count = np.unique(flat, return_inverse=True, return_counts=True)
    return of, count


def _ground_height(floor: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) height of the ground nearest to each place."""
    known = floor[np.isfinite(floor).all(axis=1)]
    if len(known) == 0 or len(xy) == 0:
        return np.zeros(len(xy))
    of, count = _cells(known[:, :2].astype(np.float64) / _GROUND_CELL, np.zeros(len(known), dtype=np.intp))
    mean = np.stack([np.bincount(of, weights=known[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    return np.asarray(mean[cKDTree(mean[:, :2]).query(xy)[1], 2])
