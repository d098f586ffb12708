"""Objects of a scene: one id and one class in all scans."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps.refine.objects import scene_instances

VOID, BARRIER, BICYCLE, BUS, CAR, PEDESTRIAN, CONE, TRUCK, ROAD, MANMADE = 0, 1, 2, 3, 4, 7, 8, 10, 11, 15
HEIGHT = 1.8
"""Of the sensor above the road."""
PERIOD = 0.5


@dataclass
class Box:
    """What stands on the road, seen from all sides."""

    label: int
    x: float
    y: float
    length: float = 4.4
    width: float = 1.8
    height: float = 1.5
    primal: int | None = None

    def points(self):
        across = np.arange(-self.width / 2, self.width / 2 + 0.01, 0.15)
        along = np.arange(-self.length / 2, self.length / 2 + 0.01, 0.15)
        rim = np.concatenate(
            [
                [[side * self.length / 2, y] for side in (-1, 1) for y in across],
                [[x, side * self.width / 2] for side in (-1, 1) for x in along],
            ]
        )
        levels = np.linspace(0.3, self.height, 4) - HEIGHT
        xyz = np.array([[x, y, z] for x, y in rim for z in levels])
        return xyz + np.array([self.x, self.y, 0])


def car(x, y, **more):
    return Box(CAR, x, y, **more)


def person(x, y):
    return Box(PEDESTRIAN, x, y, 0.5, 0.5, 1.7)


def road(step=2.0):
    x, y = np.meshgrid(np.arange(-40, 41, step), np.arange(-40, 41, step))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -HEIGHT)])


def scene(*scans):
    """The arguments of ``scene_instances``, and for each scan's boxes the slice of their points."""
    parts, labels, primal, bounds, boxes = [], [], [], [0], []
    for scan in scans:
        begin, mine = bounds[-1], []
        for box in scan:
            xyz = box.points()
            mine.append(slice(begin, begin + len(xyz)))
            begin += len(xyz)
            parts.append(xyz)
            labels.append(np.full(len(xyz), box.label))
            primal.append(np.full(len(xyz), box.label if box.primal is None else box.primal))
        ground = road()
        parts.append(ground)
        labels.append(np.full(len(ground), ROAD))
        primal.append(np.full(len(ground), ROAD))
        bounds.append(begin + len(ground))
        boxes.append(mine)
    semantic = np.concatenate(labels).astype(np.uint8)
    points = np.concatenate(parts).astype(np.float32)
    arguments = (
        points,
        np.array(bounds),
        points[semantic == ROAD],
        semantic,
        np.concatenate(primal).astype(np.uint8),
        np.zeros((len(scans), 3)),
        PERIOD * np.arange(len(scans)),
    )
    return arguments, boxes


def ids_of(*scans):
    """Per scan and box the set of ids on its points."""
    arguments, boxes = scene(*scans)
    instance, _ = scene_instances(*arguments)
    return [[set(instance[part].tolist()) for part in mine] for mine in boxes]


def test_cars_parked_half_a_metre_apart_are_two_objects_end_to_end_and_side_by_side():
    row = [car(8, 6), car(8 + 4.9, 6), car(8, 6 + 2.3)]
    for scan in ids_of(row, row):
        assert [len(ids) for ids in scan] == [1, 1, 1], "each is whole"
        assert len(set.union(*scan)) == 3


def test_parked_cars_keep_their_ids_in_all_scans():
    row = [car(8, 6), car(14, 6), car(8, -6)]
    first, *later = ids_of(*[row] * 6)
    assert all(scan == first for scan in later)


def test_a_car_that_drives_past_parked_ones_keeps_one_id_and_leaves_them_theirs():
    parked = [car(x, 6) for x in (-12, -6, 0, 6, 12)]
    scans = [[car(-14 + 3.5 * t, 2.5), *parked] for t in range(10)]
    found = ids_of(*scans)
    assert len(set.union(*(scan[0] for scan in found))) == 1
    for place in range(1, 6):
        assert len(set.union(*(scan[place] for scan in found))) == 1
    assert len(set.union(*found[0])) == 6


def test_a_car_where_another_one_has_stood_is_another_object():
    """All in a queue drive up: each is, after two scans, where the one before it was."""
    scans = [[car(x + 3.0 * t, 4) for x in (-18.0, -9.0, 0.0)] for t in range(6)]
    found = ids_of(*scans)
    for place in range(3):
        assert len(set.union(*(scan[place] for scan in found))) == 1
    assert len(set.union(*found[0])) == 3


def test_a_parked_car_that_is_hidden_for_three_scans_keeps_its_id():
    seen, hidden = [car(8, 6), car(20, 6)], [car(20, 6)]
    found = ids_of(seen, seen, hidden, hidden, hidden, seen)
    assert found[0][0] == found[-1][0]


def test_a_car_seen_from_behind_and_then_from_the_side_is_one_object():
    rear = Box(CAR, 8.0, 6.0, 0.3, 1.8)
    found = ids_of([rear], [car(10.05, 6)], [car(10.05, 6)])
    assert len(set.union(*(scan[0] for scan in found))) == 1


def test_walkers_side_by_side_are_two_objects_with_one_id_each():
    scans = [[person(-3 + 0.7 * t, 5), person(-3 + 0.7 * t, 6.2)] for t in range(8)]
    found = ids_of(*scans)
    ids = [set.union(*(scan[place] for scan in found)) for place in range(2)]
    assert [len(one) for one in ids] == [1, 1]
    assert ids[0] != ids[1]


def test_an_object_that_two_cameras_name_differently_is_one_object_of_one_class():
    front, rear = Box(CAR, 8, 6, 2.2), Box(TRUCK, 10.2, 6, 2.0)
    arguments, boxes = scene([front, rear], [front, rear])
    instance, semantic = scene_instances(*arguments)
    on_it = np.concatenate([np.arange(part.start, part.stop) for mine in boxes for part in mine])
    assert len(set(instance[on_it])) == 1
    assert set(semantic[on_it]) == {CAR}, "it has more votes, and is too low for a truck"


@pytest.mark.parametrize(("height", "expected"), [(1.5, CAR), (3.0, BUS)])
def test_what_is_too_low_for_a_bus_is_none(height, expected):
    arguments, boxes = scene([Box(BUS, 10, 6, 6.0, 2.2, height), Box(CAR, 10, 6, 6.0, 2.0, height)])
    _, semantic = scene_instances(*arguments)
    assert {int(c) for part in boxes[0] for c in semantic[part]} == {expected}


def test_the_class_that_most_scans_saw_holds_in_all():
    scans = [[Box(CAR, 8, 6, height=2.1, primal=TRUCK if t == 2 else CAR)] for t in range(5)]
    scans[2][0].label = TRUCK
    arguments, boxes = scene(*scans)
    _, semantic = scene_instances(*arguments)
    assert {int(c) for mine in boxes for c in semantic[mine[0]]} == {CAR}


def test_what_several_scans_show_to_be_short_is_no_car():
    bicycle = [Box(CAR, 8, 6, 1.7, 0.6, 1.7), Box(BICYCLE, 8, 6, 1.0, 0.4, 1.2)]
    arguments, boxes = scene(*[bicycle] * 4)
    _, semantic = scene_instances(*arguments)
    assert {int(c) for mine in boxes for part in mine for c in semantic[part]} == {BICYCLE}


def test_a_cyclist_half_called_pedestrian_is_one_object_though_it_moves():
    def cyclist(x):
        return [Box(BICYCLE, x, 4, 1.7, 0.5, 1.0), Box(PEDESTRIAN, x, 4, 0.6, 0.4, 1.7)]

    found = ids_of(*[cyclist(-8 + 2.0 * t) for t in range(8)])
    assert len(set.union(*(ids for scan in found for ids in scan))) == 1


def test_classes_stay_as_they_are_where_objects_are_not_to_choose():
    arguments, _ = scene([Box(CAR, 8, 6, 2.2), Box(TRUCK, 10.2, 6, 2.0)])
    instance, semantic = scene_instances(*arguments, one_class=False)
    assert (semantic == arguments[3]).all()
    assert len(set(instance[semantic != ROAD])) == 1


def test_stuff_and_void_get_no_id_and_keep_their_class():
    arguments, boxes = scene([car(8, 6), Box(MANMADE, 20, 6), Box(VOID, -8, 6)])
    instance, semantic = scene_instances(*arguments)
    assert set(instance[semantic == ROAD]) == {0}
    for part, label in zip(boxes[0][1:], (MANMADE, VOID), strict=True):
        assert set(instance[part]) == {0}
        assert set(semantic[part]) == {label}


def test_a_far_object_may_have_wider_gaps_than_a_near_one():
    def two_parts(x):
        return [car(x, 5, length=1.5), car(x + 1.5 + 2.2, 5, length=1.5)]

    (near,), (far,) = ids_of(two_parts(4)), ids_of(two_parts(60))
    assert len(set.union(*near)) == 2
    assert len(set.union(*far)) == 1


def test_no_scans_empty_scans_and_scans_without_things():
    nothing = np.zeros((0, 3), np.float32)
    none = np.zeros(0, np.uint8)
    for scans in (0, 3):
        instance, semantic = scene_instances(
            nothing, np.zeros(scans + 1, int), nothing, none, none, np.zeros((scans, 3)), np.arange(scans) * 0.1
        )
        assert len(instance) == len(semantic) == 0
    arguments, _ = scene([], [])
    assert set(scene_instances(*arguments)[0]) == {0}
    assert [len(scan) for scan in ids_of([], [car(8, 6)], [])] == [0, 1, 0]


def test_single_points_and_points_without_place():
    points = np.array([[5, 0, 0], [np.nan, 0, 0], [np.inf, 1, 0], [30, 0, 0]], np.float32)
    semantic = np.full(4, CAR, np.uint8)
    instance, refined = scene_instances(
        points, np.array([0, 2, 4]), points[:0], semantic, semantic, np.zeros((2, 3)), np.array([0, 0.1])
    )
    assert instance[[1, 2]].tolist() == [0, 0]
    assert (instance[[0, 3]] > 0).all()
    assert instance[0] != instance[3]
    assert (refined == CAR).all()


def test_scans_of_one_time_stamp_are_followed_like_others():
    arguments, boxes = scene(*[[car(8, 6)]] * 3)
    instance, _ = scene_instances(*arguments[:-1], np.zeros(3))
    assert len({int(i) for mine in boxes for i in instance[mine[0]]}) == 1


def test_a_thousand_cones_are_a_thousand_objects():
    x, y = np.meshgrid(np.arange(-33, 33, 2.0), np.arange(-33, 33, 2.0))
    cones = [Box(CONE, a, b, 0.3, 0.3, 0.7) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    found = ids_of(cones, cones)
    assert found[0] == found[1]
    assert len(set.union(*found[0])) == len(cones) == 1089


def small_scenes():
    box = st.builds(
        Box,
        st.sampled_from([CAR, TRUCK, PEDESTRIAN, BARRIER, BICYCLE]),
        st.integers(-15, 15).map(float),
        st.integers(-15, 15).map(float),
        st.sampled_from([0.4, 2.0, 4.0]),
        st.sampled_from([0.4, 1.5]),
        st.sampled_from([1.0, 2.0]),
    )
    return st.lists(st.lists(box, max_size=4), min_size=1, max_size=4)


@given(small_scenes())
def test_an_id_has_one_class_and_ids_run_from_one(scans):
    arguments, _ = scene(*scans)
    instance, semantic = scene_instances(*arguments)
    names = np.unique(instance[instance > 0])
    assert names.tolist() == list(range(1, len(names) + 1))
    for name in names:
        assert len(set(semantic[instance == name])) == 1
    assert ((instance > 0) == ((arguments[3] >= 1) & (arguments[3] <= 10))).all()


@given(small_scenes())
def test_the_thing_points_alone_give_the_same_objects(scans):
    arguments, _ = scene(*scans)
    points, bounds, floor, semantic, primal, *rest = arguments
    thing = np.flatnonzero(semantic != ROAD)
    instance, refined = scene_instances(*arguments)
    alone = scene_instances(points[thing], np.searchsorted(thing, bounds), floor, semantic[thing], primal[thing], *rest)
    assert (alone[0] == instance[thing]).all()
    assert (alone[1] == refined[thing]).all()


@given(small_scenes(), st.integers(0, 2**32 - 1))
def test_the_order_of_a_scans_points_does_not_matter(scans, seed):
    arguments, _ = scene(*scans)
    points, bounds, floor, semantic, primal, *rest = arguments
    rng = np.random.default_rng(seed)
    order = np.concatenate([rng.permutation(np.arange(a, b)) for a, b in pairwise(bounds)])
    before = scene_instances(*arguments)
    after = scene_instances(points[order], bounds, rng.permutation(floor), semantic[order], primal[order], *rest)
    assert (after[0] == before[0][order]).all()
    assert (after[1] == before[1][order]).all()


def test_a_person_half_called_car_in_the_only_scan_is_no_car():
    """More labels say car, but it is far short of one; the end of a car that all call car stays a car."""
    person = [Box(CAR, 8, 6, 0.7, 0.3, 1.75), Box(PEDESTRIAN, 8, 6, 0.7, 0.18, 1.75)]
    arguments, boxes = scene(person)
    _, semantic = scene_instances(*arguments)
    assert {int(c) for part in boxes[0] for c in semantic[part]} == {PEDESTRIAN}
    arguments, boxes = scene([Box(CAR, 8, 6, 0.7, 0.5, 1.75)])
    _, semantic = scene_instances(*arguments)
    assert set(semantic[boxes[0][0]].tolist()) == {CAR}
