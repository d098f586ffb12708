"""Geometry of the projection, and what a point gets from the pixel it falls on."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l3ps.project import primal_labels, project
from l3ps.segment.panoptic import PanopticImage

SIZE = (200, 100)
K = np.array([[100.0, 0, 100], [0, 100, 50], [0, 0, 1]])
# lidar: x forward, y left, z up; camera: x right, y down, z forward
FORWARD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
BACKWARD = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])

coordinate = st.floats(-50, 50, width=32)


def painted(semantic, instance, shape=(10, 20)):
    return PanopticImage(np.full(shape, semantic, np.uint8), np.full(shape, instance, np.int32), SIZE)


@given(st.floats(2, 50), st.floats(2, 197), st.floats(2, 97))
def test_a_pixels_ray_projects_back_onto_the_pixel(depth, u, v):
    ray = np.linalg.inv(K) @ [u, v, 1] * depth
    point = (np.linalg.inv(FORWARD) @ [*ray, 1])[:3].astype(np.float32)
    uv, z, seen = project(point[None], FORWARD, K, SIZE)
    assert seen[0]
    np.testing.assert_allclose(uv[0], (u, v), atol=1e-2)
    np.testing.assert_allclose(z[0], depth, rtol=1e-5)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=50))
def test_only_points_ahead_and_inside_the_margin_are_seen(points):
    xyz = np.array(points, np.float32)
    uv, z, seen = project(xyz, FORWARD, K, SIZE)
    assert (z[seen] > 1).all()
    assert (uv[seen] > 1).all()
    assert (uv[seen] < np.array(SIZE) - 1).all()
    behind = xyz[:, 0] <= 1
    assert not seen[behind].any()


def test_nan_and_zero_depth_points_are_not_seen():
    xyz = np.array([[np.nan, 0, 0], [0, 0, 0], [np.inf, 0, 0]], np.float32)
    assert not project(xyz, FORWARD, K, SIZE)[2].any()


def test_a_point_no_camera_sees_is_void_and_ids_never_cross_cameras():
    xyz = np.array([[10, 0, 0], [-10, 0, 0], [0, 10, 0]], np.float32)
    semantic, instance, _ = primal_labels(xyz, [(painted(4, 1), FORWARD, K), (painted(4, 1), BACKWARD, K)])
    assert semantic.tolist() == [4, 4, 0]
    assert instance[0] != instance[1]
    assert instance[2] == 0


def test_a_later_camera_overwrites_an_earlier_one():
    xyz = np.array([[10, 0, 0]], np.float32)
    semantic, instance, _ = primal_labels(xyz, [(painted(4, 3), FORWARD, K), (painted(11, 0), FORWARD, K)])
    assert semantic.tolist() == [11]
    assert instance.tolist() == [0]
