"""Instance ids after the vote."""

import tracemalloc

import numpy as np

from l3ps.refine.instances import correct_instances, geometric_instances

VOID, CAR, PEDESTRIAN, ROAD = 0, 4, 7, 11


def line(*x):
    return np.array([[v, 0, 0] for v in x], np.float32)


def test_a_point_that_became_a_thing_takes_the_id_of_its_nearest_kept_neighbour():
    ids = correct_instances(
        line(0, 1, 9, 10, 2, 8),
        np.array([CAR, CAR, CAR, CAR, ROAD, VOID], np.uint8),
        np.array([1, 1, 300, 300, 0, 0], np.int32),
        np.full(6, CAR, np.uint8),
    )
    assert ids.tolist() == [1, 1, 300, 300, 1, 300], "ids above 127 and 255 survive"


def test_without_a_kept_point_all_new_thing_points_share_one_new_id():
    ids = correct_instances(
        line(0, 1, 2), np.array([ROAD, ROAD, PEDESTRIAN], np.uint8), np.array([0, 0, 6]), np.array([CAR, CAR, ROAD])
    )
    assert ids.tolist() == [7, 7, 0]


def test_stuff_has_no_id():
    ids = correct_instances(line(0, 1), np.array([CAR, CAR]), np.array([5, 5]), np.array([ROAD, VOID]))
    assert ids.tolist() == [0, 0]


def test_geometry_parts_objects_by_the_gap_and_by_class():
    semantic = np.array([CAR, CAR, CAR, CAR, PEDESTRIAN, ROAD], np.uint8)
    ids = geometric_instances(line(0, 0.5, 3, 3.5, 3.6, 3.7), semantic, gap=0.7)
    assert ids[0] == ids[1]
    assert ids[2] == ids[3]
    assert len({ids[0], ids[2], ids[4]}) == 3
    assert ids[5] == 0


def test_height_does_not_part_an_object():
    xyz = np.array([[0, 0, 0], [0, 0, 2.5]], np.float32)
    assert len(set(geometric_instances(xyz, np.array([CAR, CAR]), 0.7))) == 1


def test_no_points_no_ids():
    assert len(geometric_instances(np.empty((0, 3), np.float32), np.empty(0, np.uint8), 0.7)) == 0
    assert geometric_instances(line(1), np.array([ROAD]), 0.7).tolist() == [0]


def test_a_dense_object_costs_no_more_than_its_area(rng):
    """20,000 points on 2 m × 2 m have 60 million pairs within the gap, a gigabyte if each were listed."""
    xyz = np.column_stack([rng.uniform(0, 2, (20_000, 2)), np.zeros(20_000)]).astype(np.float32)
    tracemalloc.start()
    ids = geometric_instances(xyz, np.full(20_000, CAR), 0.7)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert set(ids) == {1}
    assert peak < 50e6
