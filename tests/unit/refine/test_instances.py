"""Instance ids after the vote."""

import numpy as np

from l3ps.refine.instances import correct_instances

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


def test_no_points_no_ids():
    none = np.empty(0, np.uint8)
    assert len(correct_instances(np.empty((0, 3), np.float32), none, np.empty(0, np.int32), none)) == 0
