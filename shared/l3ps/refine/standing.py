"""Standing objects from all scans of a scene laid over each other: an id is a place, so no scan can lose it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from l3ps.refine.fragments import NEAR, divided
from l3ps.refine.kinds import KINDS, LENGTH, WIDTH, likely_class
from l3ps.refine.spots import Spots, compact, extents, linked, rectangle, top, total_votes
from l3ps.refine.tracks import Tracks

_CELL = 0.2
"""Edge in metres of the cells of the laid-over scans."""
_FARTHER = 2.0
"""How much wider parts are joined at most, far from the sensor."""
_ALIKE = 0.1
"""Share of a part's votes that must be for the class of the part it joins."""
_OCCUPIED = 3
"""Scans in which a standing object must hold a cell for a moving one to be no more than a mistake there."""
_MISTAKEN = 0.5
"""Share of a moving object's cells in a scan that must be held so."""
_HELD_CELL = 0.3


def standing_objects(spots: Spots, tracks: Tracks) -> NDArray[np.intp]:
    """(K,) object of each cell: the moving tracks, and what the others' cells of all scans together make up."""
    still = np.flatnonzero(~tracks.moves[tracks.of])
    number = len(tracks.moves)
    out = tracks.of.copy()
    if len(still) == 0:
        return out
    node, xy, kind, distance = _laid_over(spots, still)
    near = np.array([kind.near for kind in KINDS])[kind]
    place, layer = xy / near[:, None], 2.0 * kind

    def at(cells: NDArray[np.intp], share: float) -> NDArray[np.intp]:
        return linked(np.column_stack([place[cells] / share, layer[cells]]))

    cell = np.full(len(spots), -1, dtype=np.intp)
    cell[still] = node
    part = divided(spots, xy, at(np.arange(len(xy)), 1.0), cell, at)
    whole = _joined(spots, xy, kind, distance, part, cell)
    out[still] = number + whole[node]
    return _reclaimed(spots, out, tracks)


def _laid_over(
    spots: Spots, still: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]]:
    """Cells of all scans in one: each spot's cell, and the cells' places, kinds and least distance to the sensor."""
    key = np.floor((spots.xy[still] - spots.xy.min(axis=0)) / _CELL).astype(np.int64)
    wide = key.max(axis=0) + 1
    _, node, count = np.unique(
        (spots.kind[still] * wide[0] + key[:, 0]) * wide[1] + key[:, 1], return_inverse=True, return_counts=True
    )
    xy = np.stack([np.bincount(node, weights=spots.xy[still, a]) for a in (0, 1)], axis=1) / count[:, None]
    kind = np.zeros(len(count), dtype=np.intp)
    kind[node] = spots.kind[still]
    distance = np.full(len(count), np.inf)
    np.minimum.at(distance, node, spots.distance[still])
    return node, xy, kind, distance


def _joined(
    spots: Spots,
    xy: NDArray[np.float64],
    kind: NDArray[np.intp],
    distance: NDArray[np.float64],
    part: NDArray[np.intp],
    cell: NDArray[np.intp],
) -> NDArray[np.intp]:
    """(C,) parts joined, nearest first, where together they are no larger than their class and of one class."""
    number = int(part.max()) + 1
    inside = cell >= 0
    votes = total_votes(spots.votes[inside], part[cell[inside]], number)
    mass = votes.sum(axis=1)
    height = top(spots.height[inside], part[cell[inside]], number)
    extent = extents(xy, part, number)
    parent = list(range(number))

    def root(one: int) -> int:
        while parent[one] != one:
            parent[one] = parent[parent[one]]
            one = parent[one]
        return one

    for one, other in _neighbours(xy, kind, distance, part):
        a, b = root(one), root(other)
        if a == b:
            continue
        large, small = (a, b) if mass[a] >= mass[b] else (b, a)
        both = votes[a] + votes[b]
        high = max(height[a], height[b])
        union = np.stack([np.minimum(extent[a, 0], extent[b, 0]), np.maximum(extent[a, 1], extent[b, 1])])
        chosen = likely_class(np.stack([both, votes[large]]), np.array([high, height[large]]))
        length, width = rectangle(union[None])
        if length[0] > LENGTH[chosen[0]] or width[0] > WIDTH[chosen[0]]:
            continue
        if votes[small, chosen[1]] < _ALIKE * mass[small]:
            continue
        parent[small] = large
        votes[large], height[large], extent[large] = both, high, union
        mass[large] += mass[small]
    return np.array([root(one) for one in range(number)], dtype=np.intp)[part]


def _neighbours(
    xy: NDArray[np.float64], kind: NDArray[np.intp], distance: NDArray[np.float64], part: NDArray[np.intp]
) -> list[tuple[int, int]]:
    """Pairs of parts of one kind within reach of each other, nearest first; the reach grows with the distance."""
    farther = np.clip(distance / NEAR, 1.0, _FARTHER)
    reach = np.array([kind.join for kind in KINDS])[kind] * farther
    tree = cKDTree(np.column_stack([xy, 10.0 * kind]))
    pairs = tree.query_pairs(float(reach.max()), output_type="ndarray")
    pairs = pairs[part[pairs[:, 0]] != part[pairs[:, 1]]]
    away = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    near = away <= reach[pairs].min(axis=1)
    ends, away = np.sort(part[pairs[near]], axis=1), away[near]
    order = np.lexsort((away, ends[:, 1], ends[:, 0]))
    ends, away = ends[order], away[order]
    first = np.ones(len(ends), dtype=bool)
    first[1:] = (ends[1:] != ends[:-1]).any(axis=1)
    ends, away = ends[first], away[first]
    return [(int(a), int(b)) for a, b in ends[np.argsort(away, kind="stable")]]


def _reclaimed(spots: Spots, found: NDArray[np.intp], tracks: Tracks) -> NDArray[np.intp]:
    """(K,) objects, where what a moving track took for itself in a place that is never empty goes back.

    A parked car that a driving one passes is its continuation by every measure in that one scan, and that of a cyclist
    where labels call the two one thing.
    """
    moves = tracks.moves[tracks.of]
    still, moving = np.flatnonzero(~moves), np.flatnonzero(moves)
    if len(moving) == 0 or len(still) == 0:
        return found
    key = np.floor((spots.xy - spots.xy.min(axis=0)) / _HELD_CELL).astype(np.int64)
    place = key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]
    objects, moments = int(found.max()) + 1, int(spots.scan.max()) + 1
    seen = np.unique((place[still] * objects + found[still]) * moments + spots.scan[still])
    held, scans = np.unique(seen // moments, return_counts=True)
    order = np.lexsort((-scans, held // objects))
    places, first = np.unique(held[order] // objects, return_index=True)
    holder, scans = held[order[first]] % objects, scans[order[first]]
    at = np.minimum(np.searchsorted(places, place[moving]), len(places) - 1)
    occupied = (places[at] == place[moving]) & (scans[at] >= _OCCUPIED)
    view = compact(found[moving] * moments + spots.scan[moving])
    share = np.bincount(view, weights=occupied) / np.bincount(view)
    mistaken = occupied & (share[view] >= _MISTAKEN)
    out = found.copy()
    out[moving[mistaken]] = holder[at[mistaken]]
    return out
