"""Fragments of successive scans that are one object, standing or moving.

Scan by scan, fragments take the track that lies where they are: a standing object is expected where it was seen in any
scan before, a moving one where its speed has taken it since. What is left over is matched with the tracks left over by
distance (Hungarian method), which is how a track gets its first speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from l3ps.refine.kinds import KINDS
from l3ps.refine.spots import Spots

_REACH = 0.6
"""Metres between a cell and the track's cell that it continues."""
_COVER = 0.4
"""Share of a fragment's cells, or of a track's, that must agree for the fragment to take the track."""
_TOUCH = 0.2
"""Share of the fragment's cells that must agree in any case."""
_SWALLOWED = (0.25, 0.5)
"""A fragment that two tracks hold this share of, and that holds this share of them, is both objects run together."""
_FORGOTTEN = 4
"""Scans after which a moving object that was not seen again is given up."""
_FRESH = 2
"""Scans within which a track without speed may turn out to have moved."""
_ALIKE = 0.3
"""Cost of a factor e between the sizes of fragment and track, in gates."""
_OTHER_KIND = 0.4
"""Cost of a fragment of another kind, in gates."""
_STEADY = 0.4
"""Gate of a track whose speed is known, as a share of the gate by the kind's speed, but not below..."""
_STEADY_LEAST = 0.8
"""... this many metres."""
_COSTLIEST = 1.5
_FINE = 0.25
"""Metres to which two views of an object agree when one is laid on the other."""
_STILL = 0.35
"""Metres of displacement that are taken for none."""
_STANDS = 0.1
"""Agreement by which the view must be better displaced than in place for the object to count as moving."""
_SAMPLE = 64
"""Cells of a view that are looked up in the other; more do not tell more."""
_KEPT = 0.2
"""Edge in metres of the cells in which a standing object's places are kept."""

Places = NDArray[np.float64]


@dataclass(slots=True)
class _Track:
    kind: int
    places: Places
    """Where it stands, from all scans."""
    view: Places
    """Its cells in the scan that saw it last."""
    scan: int
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    moving: bool = False
    views: int = 1
    middle: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """Of the box around that view."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """Which track each cell is of.

    Attributes:
        of: (K,) track.
        moves: (T,) whether a track moves in most of its scans.
        moving: (K,) whether the cell's track moved in that scan.
    """

    of: NDArray[np.intp]
    moves: NDArray[np.bool_]
    moving: NDArray[np.bool_]


Advance = Callable[[int], None]
"""Told how many scans are done; may raise to stop."""


def follow(
    spots: Spots, fragment: NDArray[np.intp], seconds: NDArray[np.float64], advance: Advance = lambda scans: None
) -> Tracks:
    """Follow fragments through the scans.

    Args:
        spots: the scene's cells.
        fragment: (K,) fragment of each.
        seconds: (S,) time of each scan.
        advance: called before each scan.
    """
    tracks: list[_Track] = []
    of = np.full(len(spots), -1, dtype=np.intp)
    moving = np.zeros(len(spots), dtype=bool)
    order = np.argsort(spots.scan, kind="stable")
    edges = np.searchsorted(spots.scan[order], np.arange(len(seconds) + 1))
    for scan in range(len(seconds)):
        advance(scan)
        own = order[edges[scan] : edges[scan + 1]]
        if len(own) == 0:
            continue
        view = _View(spots, own, fragment)
        taken = _take_over(view, tracks, scan, seconds)
        _match(view, taken, tracks, scan, seconds)
        for lost in np.unique(view.fragment[taken < 0]):
            mine = (view.fragment == lost) & (taken < 0)
            taken[mine] = len(tracks)
            tracks.append(_Track(int(view.kind[lost]), view.xy[mine], view.xy[mine], scan, views=0))
        _update(view, taken, tracks, scan, seconds)
        of[own] = taken
        moving[own] = np.array([track.moving for track in tracks])[taken]
    share = np.bincount(of, weights=moving, minlength=len(tracks)) / np.maximum(
        np.bincount(of, minlength=len(tracks)), 1
    )
    return Tracks(of, share >= 0.5, moving)


class _View:
    """One scan's cells and fragments, numbered from 0."""

    def __init__(self, spots: Spots, own: NDArray[np.intp], fragment: NDArray[np.intp]) -> None:
        self.xy = spots.xy[own]
        self.weight = spots.count[own]
        names, self.fragment = np.unique(fragment[own], return_inverse=True)
        self.number = len(names)
        self.kind = np.zeros(self.number, dtype=np.intp)
        self.kind[self.fragment] = spots.kind[own]
        self.cells = np.bincount(self.fragment)


_FOLLOWS = np.array([kind.follows for kind in KINDS])
_SPEED = np.array([kind.speed for kind in KINDS])


def _take_over(view: _View, tracks: list[_Track], scan: int, seconds: NDArray[np.float64]) -> NDArray[np.intp]:
    """(C,) track of each cell whose fragment lies where a track is expected, else -1."""
    taken = np.full(len(view.xy), -1, dtype=np.intp)
    alive = [k for k, track in enumerate(tracks) if not track.moving or scan - track.scan <= _FORGOTTEN]
    if not alive:
        return taken
    expected = [
        tracks[k].view + tracks[k].velocity * (seconds[scan] - seconds[tracks[k].scan])
        if tracks[k].moving
        else tracks[k].places
        for k in alive
    ]
    sizes = np.array([len(places) for places in expected])
    owner = np.repeat(np.arange(len(alive)), sizes)
    layer = 10.0 * _FOLLOWS[np.array([tracks[k].kind for k in alive])]
    there = np.column_stack([np.concatenate(expected), layer[owner]])
    here = np.column_stack([view.xy, 10.0 * _FOLLOWS[view.kind[view.fragment]]])
    nearest = _nearest(there, here, _REACH)
    claim = np.where(nearest >= 0, owner[nearest], -1)
    held = _table(view.fragment, claim, view.weight, (view.number, len(alive)))
    held /= np.bincount(view.fragment, weights=view.weight)[:, None]
    nearest = _nearest(here, there, _REACH)
    holds = _table(np.where(nearest >= 0, view.fragment[nearest], -1), owner, None, (view.number, len(alive)))
    holds /= sizes[None, :]

    good = (held >= _COVER) | ((holds >= _COVER) & (held >= _TOUCH))
    best = np.where(good.any(axis=1), np.where(good, held + holds, -1.0).argmax(axis=1), -1)
    chosen = best[view.fragment]
    known = np.array([tracks[k].views >= 2 for k in alive])
    swallowed = (held >= _SWALLOWED[0]) & (holds >= _SWALLOWED[1]) & known[None, :]
    for one in np.flatnonzero(swallowed.sum(axis=1) >= 2):
        mine = np.flatnonzero(view.fragment == one)
        sure = mine[(claim[mine] >= 0) & swallowed[one, claim[mine]]]
        if len(sure):
            chosen[mine] = claim[sure][cKDTree(view.xy[sure]).query(view.xy[mine])[1]]
    found = chosen >= 0
    taken[found] = np.array(alive)[chosen[found]]
    return taken


def _match(view: _View, taken: NDArray[np.intp], tracks: list[_Track], scan: int, seconds: NDArray[np.float64]) -> None:
    """Give fragments without a track the free tracks nearest to them; writes into ``taken``."""
    lost = np.unique(view.fragment[taken < 0])
    used = set(taken[taken >= 0].tolist())
    free = [
        k
        for k, track in enumerate(tracks)
        if k not in used and scan - track.scan <= (_FORGOTTEN if track.moving else _FRESH)
    ]
    if len(lost) == 0 or not free:
        return
    low, high = np.full((view.number, 2), np.inf), np.full((view.number, 2), -np.inf)
    np.minimum.at(low, view.fragment, view.xy)
    np.maximum.at(high, view.fragment, view.xy)
    waited = np.array([seconds[scan] - seconds[tracks[k].scan] for k in free])
    place = np.array([tracks[k].middle + tracks[k].velocity * wait for k, wait in zip(free, waited, strict=True)])
    kind = np.array([tracks[k].kind for k in free])
    steady = np.array([tracks[k].moving for k in free])
    gate = _SPEED[kind] * waited
    gate = np.maximum(np.where(steady, np.maximum(gate * _STEADY, _STEADY_LEAST), gate), 0.1)
    distance = np.linalg.norm(((low + high) / 2)[lost][:, None] - place[None], axis=2)
    ratio = np.abs(np.log(view.cells[lost][:, None] / np.array([len(tracks[k].view) for k in free])[None]))
    other = _FOLLOWS[view.kind[lost]][:, None] != _FOLLOWS[kind][None]
    cost = distance / gate + _ALIKE * ratio + _OTHER_KIND * other
    cost = np.where((distance <= gate) & (cost < _COSTLIEST), cost, 1e3)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        if cost[row, column] < _COSTLIEST:
            taken[(view.fragment == lost[row]) & (taken < 0)] = free[column]


def _update(
    view: _View, taken: NDArray[np.intp], tracks: list[_Track], scan: int, seconds: NDArray[np.float64]
) -> None:
    """Let the tracks of this scan know what they look like now, and which way they went."""
    order = np.argsort(taken, kind="stable")
    names, first = np.unique(taken[order], return_index=True)
    now = dict(zip(names.tolist(), np.split(view.xy[order], first[1:]), strict=True))
    seen = [k for k in now if tracks[k].views > 0]
    if seen:
        waited = np.array([seconds[scan] - seconds[tracks[k].scan] for k in seen])
        moved = _displacement([tracks[k].view for k in seen], [now[k] for k in seen],
                              np.array([tracks[k].velocity for k in seen]) * waited[:, None])  # fmt: skip
        for k, shift, wait in zip(seen, moved, waited, strict=True):
            track, was_moving = tracks[k], tracks[k].moving
            track.moving = bool(np.hypot(*shift) >= _STILL) and wait > 0
            velocity = shift / wait if track.moving else np.zeros(2)
            track.velocity = (track.velocity + velocity) / 2 if track.moving and was_moving else velocity
    middle, _ = _centres(view.xy[order], first)
    for (k, cells), centre in zip(now.items(), middle, strict=True):
        track = tracks[k]
        track.view, track.scan, track.views, track.middle = cells, scan, track.views + 1, centre
        if track.moving:
            track.places = cells
    still = [tracks[k] for k in now if not tracks[k].moving]
    both = [np.concatenate([track.places, track.view]) for track in still]
    for track, places in zip(still, _thinned(both), strict=True):
        track.places = places


def _thinned(sets: list[Places]) -> list[Places]:
    """Of each set one place a cell."""
    if not sets:
        return sets
    places, of = np.concatenate(sets), np.repeat(np.arange(len(sets)), [len(one) for one in sets])
    key = np.round(places / _KEPT).astype(np.int64)
    key -= key.min(axis=0)
    wide = key.max(axis=0) + 1
    kept = np.unique((of * wide[0] + key[:, 0]) * wide[1] + key[:, 1], return_index=True)[1]
    return np.split(places[kept], np.searchsorted(of[kept], np.arange(1, len(sets))))


def _centres(cells: Places, first: NDArray[np.intp]) -> tuple[Places, Places]:
    """Middles of the boxes around views (V, 2), and their means; the cells of each view begin at ``first``."""
    low, high = np.minimum.reduceat(cells, first), np.maximum.reduceat(cells, first)
    count = np.diff(np.append(first, len(cells)))
    return (low + high) / 2, np.add.reduceat(cells, first) / count[:, None]


def _displacement(before: list[Places], after: list[Places], predicted: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T, 2) metres by which each view is displaced from the one before: the guess under which the two agree best.

    Guesses are none, the way the middle went, the way the mean went, and ``predicted``. The middle alone misleads:
    a parked car seen first from behind and then from the side has moved by that measure.
    """
    number = len(before)
    old, new = np.concatenate(before), np.concatenate(after)
    sizes = [np.array([len(places) for places in views]) for views in (before, after)]
    of_old, of_new = (np.repeat(np.arange(number), size) for size in sizes)
    (old_middle, old_mean), (new_middle, new_mean) = (
        _centres(cells, np.cumsum(size) - size) for cells, size in zip((old, new), sizes, strict=True)
    )
    guesses = np.stack([np.zeros((number, 2)), new_middle - old_middle, new_mean - old_mean, predicted])
    old_tree = cKDTree(np.column_stack([old, 100.0 * of_old]))
    new_tree = cKDTree(np.column_stack([new, 100.0 * of_new]))
    sample_old, sample_new = _sample(of_old), _sample(of_new)
    agreement = np.zeros((len(guesses), number))
    for row, shift in enumerate(guesses):
        for tree, cells, of in (
            (new_tree, (old + shift[of_old])[sample_old], of_old[sample_old]),
            (old_tree, (new - shift[of_new])[sample_new], of_new[sample_new]),
        ):
            away, _ = tree.query(np.column_stack([cells, 100.0 * of]), distance_upper_bound=_FINE)
            share = np.bincount(of, weights=np.isfinite(away)) / np.bincount(of)
            agreement[row] = np.maximum(agreement[row], share)
    agreement[0] += _STANDS
    return np.asarray(guesses[agreement.argmax(axis=0), np.arange(number)])


def _sample(of: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of every so many cells of each view, some :data:`_SAMPLE` of it; ``of`` ascends."""
    count = np.bincount(of)
    rank = np.arange(len(of)) - (np.cumsum(count) - count)[of]
    return np.flatnonzero(rank % np.maximum(count // _SAMPLE, 1)[of] == 0)


def _nearest(points: Places, queries: Places, reach: float) -> NDArray[np.intp]:
    """(Q,) index of the nearest point to each query, -1 where none is within reach."""
    away, index = cKDTree(points).query(queries, distance_upper_bound=reach)
    return np.where(np.isfinite(away), index, -1)


def _table(
    row: NDArray[np.intp], column: NDArray[np.intp], weight: NDArray[np.float64] | None, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Sum of weights in each cell of a table; negative rows and columns are left out."""
    use = (row >= 0) & (column >= 0)
    flat = row[use] * shape[1] + column[use]
    chosen = None if weight is None else weight[use]
    return np.bincount(flat, weights=chosen, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)
