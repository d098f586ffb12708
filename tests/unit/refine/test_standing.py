"""Fragments of a scan, and standing objects of all scans."""

import numpy as np

from l3ps.refine.fragments import find_fragments
from l3ps.refine.spots import find_spots
from l3ps.refine.standing import standing_objects
from l3ps.refine.tracks import Tracks

CAR = 4


def block(x, y, length=4.0, width=1.8, step=0.2):
    """Points of a thing on the road, 1.5 m high."""
    a, b = np.meshgrid(np.arange(0, length, step), np.arange(0, width, step))
    return np.column_stack([x + a.ravel(), y + b.ravel(), np.full(a.size, 1.5)])


def spots_of(*scans):
    """Cells of scans of cars, each given by its blocks."""
    clouds = [np.concatenate(blocks) for blocks in scans]
    points = np.concatenate(clouds).astype(np.float32)
    semantic = np.full(len(points), CAR, np.uint8)
    bounds = np.cumsum([0, *map(len, clouds)])
    return find_spots(points, bounds, points[:0], semantic, semantic, np.zeros((len(scans), 3)))


def test_gaps_of_a_fragment_grow_with_the_distance():
    for distance, fragments in ((5, 2), (70, 1)):
        spots = spots_of([block(distance, 0, 1.5), block(distance + 1.5 + 1.2, 0, 1.5)])
        assert len(set(find_fragments(spots))) == fragments


def test_standing_cells_are_one_object_whatever_the_tracks_of_the_scans_were():
    spots = spots_of(*[[block(8, 3)]] * 4)
    found = standing_objects(spots, Tracks(spots.scan.copy(), np.zeros(4, bool), np.zeros(4, bool)))
    assert len(set(found)) == 1


def test_a_moving_track_gives_back_what_stands_in_the_other_scans():
    """In its third scan the moving track took the parked car, and left its own."""
    driving = [block(-9 + 3 * t, 0) for t in range(5)]
    parked = block(8, 6)
    spots = spots_of(*[[driving[t], parked] for t in range(5)])
    is_parked = spots.xy[:, 1] > 4
    of = np.where(is_parked, 1, 0)
    of[is_parked & (spots.scan == 2)] = 0
    found = standing_objects(spots, Tracks(of, np.array([True, False]), of == 0))
    assert len(set(found[is_parked])) == 1
    assert not set(found[is_parked]) & set(found[~is_parked])


def test_a_moving_track_keeps_the_place_where_nothing_else_stands():
    spots = spots_of(*[[block(-9 + 3 * t, 0), block(8, 6)] for t in range(5)])
    of = np.where(spots.xy[:, 1] > 4, 1, 0)
    found = standing_objects(spots, Tracks(of, np.array([True, False]), of == 0))
    assert len(set(found[of == 0])) == 1
