"""Objects of a whole scene, each with one id and one class in all scans (an addition to the paper's section III-D).

thing points ─▶ cells ─▶ fragments of each scan ─▶ tracks ─▶ what lies in their way ─▶ standing objects from all scans
─▶ one class each
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l3ps.refine.fragments import NEAR, find_fragments, mingled, of_one_kind
from l3ps.refine.kinds import likely_class
from l3ps.refine.spots import Spots, extents, find_spots, quantile, rectangle, top, total_votes
from l3ps.refine.standing import standing_objects
from l3ps.refine.tracks import Advance, follow
from l3ps.refine.ways import clear_ways

_USUAL = 0.6
"""Share of an object's scans whose view is no larger than the size that decides its class."""
_MOST = 0.9
"""The same for the size that it must reach."""
_SEVERAL = 3
"""Scans, one of them from within :data:`~l3ps.refine.fragments.NEAR`, that show an object's whole length."""


def scene_instances(
    points: NDArray[np.float32],
    bounds: NDArray[np.integer],
    floor: NDArray[np.float32],
    semantic: NDArray[np.uint8],
    primal: NDArray[np.uint8],
    origins: NDArray[np.float64],
    seconds: NDArray[np.float64],
    *,
    one_class: bool = True,
    advance: Advance = lambda scans: None,
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Find the objects of a scene, follow them through its scans and let each choose one class.

    Args:
        points: (N, 3) float32, metres, scene frame, z up: all points or the things alone, which gives the same.
        bounds: (S + 1,) where each scan begins among the points, and N.
        floor: (G, 3) float32 points of the ground, metres, scene frame; heights are measured from it.
        semantic: (N,) uint8 class after the vote. Things stay things and stuff stays stuff.
        primal: (N,) uint8 class before it; its things vote for the objects' classes.
        origins: (S, 3) the sensor's place at each scan, metres, scene frame.
        seconds: (S,) time of each scan, ascending.
        one_class: let each object choose one class; else points keep theirs, and an object may have several.
        advance: told how many scans are done; may raise to stop.

    Returns:
        (N,) int32 id from 1, one an object in all scans and unique over all classes, 0 for stuff, void and points that
        are not finite; and (N,) uint8 class, the same for all points of an object.
    """
    spots = find_spots(points, bounds, floor, semantic, primal, origins)
    instance = np.zeros(len(points), dtype=np.int32)
    if len(spots) == 0:
        return instance, semantic
    fragment = mingled(spots, find_fragments(spots))
    clean = of_one_kind(spots, fragment)
    tracks, claimed = clear_ways(clean, fragment, follow(clean, fragment, seconds, advance), seconds)
    found = standing_objects(of_one_kind(spots, tracks.of), tracks)
    found = _by_first_cell(found)
    instance[spots.member] = found[spots.of] + 1
    if not one_class:
        return instance, semantic
    refined = semantic.copy()
    refined[spots.member] = classes_of(spots, found, ~claimed)[found][spots.of]
    return instance, refined


def _by_first_cell(found: NDArray[np.intp]) -> NDArray[np.intp]:
    """The objects numbered from 0 in the order in which the scans come to see them."""
    _, first, of = np.unique(found, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[of]


def classes_of(spots: Spots, found: NDArray[np.intp], heard: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(O,) class of each object by the votes of all its points and its usual size in a scan.

    Of cells that are not ``heard`` only the place is known to be the object's: labels called them something else, and
    they vote where the object has no others.
    """
    number = int(found.max()) + 1
    heard = heard | (np.bincount(found[heard], minlength=number) == 0)[found]
    scans = int(spots.scan.max()) + 1
    object_of = found[heard]
    names, view = np.unique(object_of.astype(np.int64) * scans + spots.scan[heard], return_inverse=True)
    of = names // scans
    length, width = rectangle(extents(spots.xy[heard], view, len(names)))
    height = top(spots.height[heard], view, len(names))
    high, long, wide = (quantile(values, of, number, _USUAL) for values in (height, length, width))
    distance = np.full(number, np.inf)
    np.minimum.at(distance, object_of, spots.distance[heard])
    longest = np.where(distance < NEAR, quantile(length, of, number, _MOST), np.inf)
    well_seen = np.bincount(of, minlength=number) >= _SEVERAL
    votes = total_votes(spots.votes[heard], object_of, number)
    return likely_class(votes, high, long, wide, longest, well_seen).astype(np.uint8)
