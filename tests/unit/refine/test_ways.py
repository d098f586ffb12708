"""What lies in the way of a moving object is that object."""

import numpy as np
import pytest

from l3ps.refine.fragments import find_fragments
from l3ps.refine.objects import classes_of
from l3ps.refine.spots import find_spots
from l3ps.refine.tracks import Tracks
from l3ps.refine.ways import clear_ways

BICYCLE, CAR, PEDESTRIAN = 2, 4, 7
PERIOD = 0.5


def block(x, y, length=4.0, width=1.8, step=0.2, label=CAR):
    """Points of a thing on the road, 1.5 m high, and what they are called."""
    a, b = np.meshgrid(np.arange(0, length, step), np.arange(0, width, step))
    return np.column_stack([x + a.ravel(), y + b.ravel(), np.full(a.size, 1.5), np.full(a.size, label)])


def driving(scan, **more):
    return block(-20 + 3.5 * scan, 0, **more)


def after(scans, of, moves=True):
    """The cells of scans given by blocks, and their tracks; ``of`` tells the track before by scan and place."""
    clouds = [np.concatenate(blocks) for blocks in scans]
    points = np.concatenate(clouds)
    semantic = points[:, 3].astype(np.uint8)
    bounds = np.cumsum([0, *map(len, clouds)])
    xyz, origins = points[:, :3].astype(np.float32), np.zeros((len(scans), 3))
    spots = find_spots(xyz, bounds, np.zeros((0, 3), np.float32), semantic, semantic, origins)
    before = np.array([of(scan, *xy) for scan, xy in zip(spots.scan, spots.xy, strict=True)])
    moving = np.broadcast_to(moves, before.max() + 1)[before]
    tracks = Tracks(before, np.broadcast_to(moves, before.max() + 1), moving)
    cleared, claimed = clear_ways(spots, find_fragments(spots), tracks, PERIOD * np.arange(len(scans)))
    return spots, cleared, claimed


@pytest.mark.parametrize("lost", [0, 1, 4, 7])
@pytest.mark.parametrize("label", [CAR, PEDESTRIAN])
def test_a_car_that_is_lost_in_one_scan_is_found_again(lost, label):
    """In its first, a middle or its last scan, where half of it is a track of its own, whatever it is called there."""
    scans = [
        [driving(t)] if t != lost else [driving(t, length=2.0, label=label), block(-18 + 3.5 * t + 0.2, 0, 1.8)]
        for t in range(8)
    ]
    spots, cleared, claimed = after(scans, lambda scan, x, y: int(scan == lost))
    assert len(set(cleared.of)) == 1
    assert (claimed == (spots.scan == lost)).all()


def test_a_track_that_goes_over_to_another_car_is_cut_and_both_are_whole():
    scans = [[driving(t), block(20 - 3.5 * t, 3.5)] for t in range(10)]

    def swapped(scan, x, y):
        return int((y > 3) != (scan >= 5))

    spots, cleared, _ = after(scans, swapped)
    first, second = (set(cleared.of[(spots.xy[:, 1] > 3) == there]) for there in (False, True))
    assert len(first) == len(second) == 1
    assert first != second


def test_what_a_car_drives_up_to_but_stands_is_not_taken():
    """The track is sure of its way, and the way leads over the parked car."""
    scans = [[block(-20 + 3.0 * t, 0)] for t in range(5)] + [[block(0, 0)]] * 3
    spots, cleared, _ = after(scans, lambda scan, x, y: int(x >= 0), np.array([True, False]))
    parked = spots.xy[:, 0] >= 0
    assert not set(cleared.of[parked]) & set(cleared.of[~parked])
    assert len(set(cleared.of[parked])) == 1


def test_a_neighbour_in_the_next_lane_keeps_its_track():
    scans = [[driving(t), *([driving(t) + np.array([0, 3.0, 0, 0])] if t in (3, 4) else [])] for t in range(8)]
    spots, cleared, _ = after(scans, lambda scan, x, y: int(y > 2.4))
    assert not set(cleared.of[spots.xy[:, 1] > 2.4]) & set(cleared.of[spots.xy[:, 1] < 2.4])


def test_a_car_that_brakes_and_turns_stays_one():
    speed = np.array([3.5, 3.5, 3.0, 2.4, 1.8, 1.2])
    x = np.concatenate([[0], np.cumsum(speed)])
    y = np.array([0, 0, 0.1, 0.3, 0.7, 1.2, 1.8])
    _, cleared, _ = after([[block(a, b)] for a, b in zip(x, y, strict=True)], lambda *_: 0)
    assert len(set(cleared.of)) == 1


def test_scans_of_one_time_stamp_do_no_harm():
    spots, _, _ = after([[driving(t)] for t in range(4)], lambda *_: 0)
    tracks = Tracks(np.zeros(len(spots), int), np.array([True]), np.ones(len(spots), bool))
    assert len(clear_ways(spots, find_fragments(spots), tracks, np.zeros(4))[0].of) == len(spots)


def test_what_was_claimed_has_no_say_in_the_class_unless_nothing_else_has():
    small = {"length": 1.2, "width": 0.6}
    scans = [[block(8, 0, **small)], [block(8, 0, **small, label=PEDESTRIAN, step=0.1)]]
    spots, _, _ = after(scans, lambda *_: 0)
    one = np.zeros(len(spots), int)
    assert classes_of(spots, one, np.ones(len(spots), bool)).tolist() == [PEDESTRIAN]
    assert classes_of(spots, one, spots.scan == 0).tolist() == [CAR]
    assert classes_of(spots, one, np.zeros(len(spots), bool)).tolist() == [PEDESTRIAN]
