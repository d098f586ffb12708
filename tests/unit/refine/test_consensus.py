"""Who decides a point's class: what a user sees of cars, people, walls and kerbs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps.labels.types import Evidence
from l3ps.presets import Consensus
from l3ps.refine.consensus import by_consensus

VOID, BICYCLE, BUS, CAR, PEDESTRIAN, TRAILER, TRUCK, ROAD, SIDEWALK, MANMADE = 0, 2, 3, 4, 7, 9, 10, 11, 13, 15
RULES = Consensus()


def box(rng, low, high, count):
    return rng.uniform(low, high, (count, 3)).astype(np.float32)


def classes(points, semantic, *, ground=False, cluster=0, evidence=None, rules=RULES):
    ground = np.broadcast_to(np.asarray(ground), len(points)).copy()
    cluster = np.broadcast_to(np.asarray(cluster, np.int32), len(points)).copy()
    evidence = Evidence.of_labels(np.asarray(semantic, np.uint8)) if evidence is None else evidence
    return by_consensus(points, ground, cluster, evidence, rules)


def test_a_pedestrian_leaning_at_a_parked_car_keeps_its_class_although_they_are_one_cluster(rng):
    car, person = box(rng, (0, 0, 0), (4, 1.8, 1.5), 2000), box(rng, (4, 0.8, 0), (4.4, 1.2, 1.7), 80)
    semantic = np.repeat([CAR, PEDESTRIAN], [2000, 80])
    found = classes(np.concatenate([car, person]), semantic).semantic
    assert (found[2000:] == PEDESTRIAN).mean() > 0.9
    assert (found[:2000] == CAR).mean() > 0.97


def test_stray_labels_in_a_cluster_are_repaired(rng):
    points = box(rng, (0, 0, 0), (4, 1.8, 1.5), 2000)
    semantic = np.where(rng.random(2000) < 0.2, MANMADE, CAR)
    assert (classes(points, semantic).semantic == CAR).all()


def test_a_point_no_camera_saw_takes_the_class_of_its_place_else_of_its_cluster(rng):
    place, away, elsewhere = np.zeros((20, 3)), np.full((1, 3), 9.0), np.full((1, 3), 30.0)
    points = np.concatenate([place, place[:1], away, elsewhere]).astype(np.float32)
    semantic = [CAR] * 20 + [VOID] * 3
    found = classes(points, semantic, cluster=[0] * 22 + [1])
    assert found.semantic.tolist() == [CAR] * 22 + [VOID], "nothing is known of the last: another place and cluster"
    assert found.share[22] == 0
    assert found.heard[20] and not found.heard[21]


def test_many_scans_of_a_place_outvote_one(rng):
    points = (rng.normal(0, 0.02, (40, 3)) + 0.25).astype(np.float32)
    assert (classes(points, [MANMADE] * 37 + [CAR] * 3, cluster=-1).semantic == MANMADE).all()


def test_ground_takes_ground_classes_and_nothing_else_does(rng):
    points = box(rng, (0, 0, 0), (0.4, 0.4, 0.1), 60)
    on_ground = classes(points, [CAR] * 30 + [ROAD] * 30, ground=True)
    above = classes(points, [CAR] * 30 + [ROAD] * 30, ground=False)
    assert (on_ground.semantic == ROAD).all()
    assert (above.semantic == CAR).all()


def test_overwhelming_evidence_crosses_the_partition(rng):
    """Patchwork++ takes feet and the lowest rows of cars for ground."""
    points = box(rng, (0, 0, 0), (0.4, 0.4, 0.1), 60)
    assert (classes(points, [CAR] * 57 + [ROAD] * 3, ground=True).semantic == CAR).all()


def test_one_cluster_of_ground_can_be_road_here_and_sidewalk_there(rng):
    road, walk = box(rng, (0, 0, 0), (8, 3, 0.05), 2000), box(rng, (0, 3, 0.1), (8, 5, 0.15), 2000)
    semantic = np.repeat([ROAD, SIDEWALK], 2000)
    noisy = np.where(rng.random(4000) < 0.2, SIDEWALK + ROAD - semantic, semantic)
    found = classes(np.concatenate([road, walk]), noisy, ground=True).semantic
    assert (found == semantic).mean() > 0.93


def test_ground_that_few_cameras_saw_goes_by_its_level_not_by_what_lies_beside_it(rng):
    """A kerb of 15 cm in the middle of a square; of the pavement only a strip was seen."""
    wide = RULES.square
    road = box(rng, (0, 0, 0), (wide / 2, wide, 0.02), 3000)
    walk = box(rng, (wide / 2, 0, 0.16), (wide, wide, 0.18), 3000)
    points = np.concatenate([road, walk])
    semantic = np.repeat([ROAD, SIDEWALK], 3000)
    seen = (points[:, 0] < wide / 2) | (points[:, 1] < 0.5)
    found = classes(points, np.where(seen, semantic, VOID), ground=True).semantic
    np.testing.assert_array_equal(found, semantic)


def test_votes_weigh_by_their_confidence(rng):
    points = np.zeros((3, 3), np.float32)
    pixels = np.array([[CAR, TRUCK, VOID]] * 3, np.uint8)
    weights = np.array([[90, 10, 0], [40, 60, 0], [40, 60, 0]], np.uint8)
    seen = Evidence(pixels, weights, np.ones(3, np.uint8), np.ones(3, bool))
    assert classes(points, [], evidence=seen).semantic.tolist() == [CAR] * 3
    assert classes(points, [CAR, TRUCK, TRUCK]).semantic[1:].tolist() == [TRUCK] * 2, "by heads it is two to one"


@pytest.mark.parametrize(("few", "many", "ground"), [(PEDESTRIAN, MANMADE, False), (SIDEWALK, ROAD, True)])
def test_what_is_rare_wins_against_a_narrow_majority_of_what_is_common(few, many, ground):
    points = np.zeros((100, 3), np.float32)
    ballot = np.array([[few, many, VOID]] * 100, np.uint8)
    for share, winner in ((40, few), (25, many)):
        weights = np.array([[share, 100 - share, 0]] * 100, np.uint8)
        seen = Evidence(ballot, weights, np.ones(100, np.uint8), np.ones(100, bool))
        assert set(classes(points, [], ground=ground, evidence=seen).semantic) == {winner}


def test_where_a_place_is_undecided_each_point_goes_by_its_own_pixels():
    points = np.zeros((100, 3), np.float32)
    semantic = np.repeat([CAR, MANMADE], 50)
    np.testing.assert_array_equal(classes(points, semantic).semantic, semantic)


def test_void_is_no_vote():
    points = np.zeros((10, 3), np.float32)
    found = classes(points, [VOID] * 9 + [CAR])
    assert (found.semantic == CAR).all()


@given(
    st.lists(st.tuples(st.integers(-1, 4), st.integers(0, 16), st.booleans(), st.integers(0, 3)), max_size=120),
    st.integers(0, 1000),
)
def test_any_scene_gets_one_label_a_point_from_what_was_said(rows, seed):
    """Clusters of one, no clusters, lost returns, far outliers: never a class that nobody named."""
    cluster, semantic, ground, kind = (np.array(column) for column in zip(*rows, strict=True)) if rows else [[]] * 4
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (len(rows), 3)).astype(np.float32)
    kind = np.asarray(kind)
    points[kind == 1] = np.nan
    points[kind == 2] += np.float32(3e7)
    found = classes(points, np.asarray(semantic, np.uint8), ground=np.asarray(ground, bool), cluster=cluster)
    assert found.semantic.shape == found.share.shape == (len(rows),)
    assert set(found.semantic.tolist()) <= set(np.asarray(semantic).tolist()) | {VOID}
    assert ((found.share >= 0) & (found.share <= 1 + 1e-5)).all()
    assert ((found.share > 0) == (found.semantic != VOID)).all()


def test_the_order_of_the_points_does_not_matter(rng):
    points = box(rng, (0, 0, 0), (5, 5, 3), 600)
    semantic = rng.choice([VOID, CAR, ROAD, MANMADE], 600).astype(np.uint8)
    cluster = (points[:, 0] > 2).astype(np.int32)
    ground = points[:, 2] < 0.5
    first = classes(points, semantic, ground=ground, cluster=cluster).semantic
    order = rng.permutation(600)
    again = classes(points[order], semantic[order], ground=ground[order], cluster=cluster[order]).semantic
    np.testing.assert_array_equal(again, first[order])
