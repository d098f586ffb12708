"""The ids of a scene: once for all its scans, in parts only where the poses tear."""

import numpy as np
import pytest

from l3ps.errors import Cancelled
from l3ps.labels.types import Provenance, ScanLabels
from l3ps.presets import BEST
from l3ps.refine.identify import VotedScan, identify
from l3ps.refine.poses import Motion
from l3ps.refine.verdict import Verdict

CAR, TRUCK, ROAD = 4, 10, 11


def block(x, y):
    """A car of 4 m on the road."""
    a, b, c = np.meshgrid(np.arange(0, 4, 0.2), np.arange(0, 1.8, 0.2), (0.5, 1.4))
    return np.column_stack([x + a.ravel(), y + b.ravel(), c.ravel()])


def scan_of(token, *cars, wrong=0.0):
    """A scan of cars on a road, ``wrong`` of whose points are called trucks; and its primal labels."""
    road = np.column_stack(
        [*(axis.ravel() for axis in np.meshgrid(np.arange(-20, 20), np.arange(-20, 20))), [0] * 1600]
    )
    points = np.concatenate([road, *cars]).astype(np.float32)
    on_road = np.arange(len(points)) < len(road)
    semantic = np.where(on_road, ROAD, CAR).astype(np.uint8)
    semantic[~on_road & (np.arange(len(points)) % 100 < 100 * wrong)] = TRUCK
    sure = np.full(len(points), 200, np.uint8)
    verdict = Verdict(semantic, sure, np.full(len(points), Provenance.CLUSTER, np.uint8))
    return VotedScan.of(token, points, on_road, verdict), ScanLabels(token, semantic, np.zeros(len(points), np.int32))


def motion(scans, *cuts):
    nothing = np.zeros(scans)
    return Motion(np.tile(np.eye(4), (scans, 1, 1)), "log", (0, *cuts), nothing, nothing, np.zeros((scans, 6)))


def ids_of(pairs, *cuts, **more):
    scans, primal = zip(*pairs, strict=True)
    labels = identify(scans, primal, motion(len(scans), *cuts), 0.5 * np.arange(len(scans)), BEST, **more)
    return [np.unique(one.instance[one.instance > 0]).tolist() for one in labels]


def test_an_object_has_one_id_in_all_scans():
    assert ids_of([scan_of("a", block(4, 3), block(12, 3))] * 4) == [[1, 2]] * 4


def test_where_the_poses_tear_objects_end_and_their_ids_are_not_given_again():
    street = [scan_of("a", block(4, 3), block(12, 3))] * 4
    assert ids_of(street, 2, 3) == [[1, 2], [1, 2], [3, 4], [5, 6]]
    assert ids_of([*street[:2], scan_of("empty"), street[3]], 2, 3) == [[1, 2], [1, 2], [], [3, 4]]


def test_what_an_object_decides_reaches_its_points_and_no_others():
    (scan, primal), (other, _) = scan_of("a", block(4, 3), wrong=0.2), scan_of("b", block(4, 3))
    first, second = identify([scan, other], [primal, primal], motion(2), np.array([0, 0.5]), BEST)
    assert [labels.token for labels in (first, second)] == ["a", "b"]
    assert set(first.semantic[1600:]) == set(second.semantic[1600:]) == {CAR}
    turned = scan.verdict.semantic == TRUCK
    assert turned.any()
    assert (first.provenance == np.where(turned, Provenance.INSTANCE_RULE, Provenance.CLUSTER)).all()
    assert (scan.verdict.semantic[turned] == TRUCK).all(), "what was given is left as it was"


def test_it_tells_of_each_scan_and_can_be_stopped_between_two():
    street = [scan_of("a", block(4, 3))] * 4
    told = []
    ids_of(street, 2, progress=lambda stage, done, total: told.append((stage, done, total)))
    assert told == sorted(told) and set(told) == {("instances", done, 4) for done in range(5)}

    def stop(stage, done, total):
        if done == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        ids_of(street, progress=stop)


def test_a_scene_without_scans_has_no_labels():
    assert identify([], [], motion(0), np.zeros(0), BEST) == []
