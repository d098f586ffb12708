"""Geometry of the projection, and what a point gets from the pixel it falls on."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l3ps.project import Weighing, primal_labels, project
from l3ps.segment.panoptic import PanopticImage
from l3ps.segment.scores import ClassScores

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


def wall(x, y, z):
    """A grid of points on the plane at distance ``x`` ahead, dense as a LiDAR's returns."""
    across, up = np.meshgrid(np.arange(*y, 0.05), np.arange(*z, 0.05))
    return np.column_stack([np.full(across.size, x), across.ravel(), up.ravel()]).astype(np.float32)


def test_a_point_behind_a_nearer_surface_gets_that_surfaces_label_but_not_its_vote():
    car, hidden, beside = wall(8, (-1, 1), (-1, 1)), np.array([[20, 0, 0]], np.float32), wall(20, (4, 6), (-1, 1))
    xyz = np.concatenate([car, hidden, beside])
    semantic, _, evidence = primal_labels(xyz, [(painted(4, 1), FORWARD, K)])
    assert (semantic == 4).all(), "the published labels do not know"
    assert evidence.weights[len(car)].sum() == 0 == evidence.cameras[len(car)]
    assert (evidence.cameras[: len(car)] == 1).all()
    assert (evidence.cameras[len(car) + 1 :] == 1).all(), "what is far but open to view keeps its vote"


def test_ground_that_runs_to_the_horizon_does_not_hide_itself():
    x, y = np.meshgrid(np.geomspace(4, 60, 120), np.linspace(-2, 2, 40))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.6)]).astype(np.float32)
    _, _, evidence = primal_labels(xyz, [(painted(11, 0), FORWARD, K)])
    seen = project(xyz, FORWARD, K, SIZE)[2]
    assert evidence.cameras[seen].mean() > 0.99


def test_cameras_that_overlap_vote_together_instead_of_overwriting():
    xyz = np.array([[10, 0, 0], [10, 1, 0]], np.float32)
    views = [(painted(c, 0), FORWARD, K) for c in (4, 4, 11)]
    semantic, _, evidence = primal_labels(xyz, views, Weighing(near=0))
    assert semantic.tolist() == [11, 11]
    assert evidence.classes[:, :2].tolist() == [[4, 11]] * 2
    assert evidence.weights[:, :2].tolist() == [[200, 100]] * 2
    assert evidence.cameras.tolist() == [3, 3]
    assert not evidence.agree.any()
    assert primal_labels(xyz, views[:2])[2].agree.all()


def test_probabilities_are_carried_and_share_the_vote_with_the_label():
    logits = np.zeros((4, 10, 20), np.float32)
    logits[2] = np.log(3)  # 1/6 void, 1/6 car, 3/6 truck, 1/6 truck again
    scores = ClassScores(logits, np.array([0, 4, 10, 10], np.uint8))
    image = PanopticImage(np.full((10, 20), 4, np.uint8), np.zeros((10, 20), np.int32), SIZE, scores)
    np.testing.assert_allclose(scores.at(np.array([3]), np.array([7]))[0, [0, 4, 10]], [1 / 6, 1 / 6, 4 / 6], rtol=1e-6)
    _, _, evidence = primal_labels(np.array([[10, 0, 0]], np.float32), [(image, FORWARD, K)], Weighing(near=0))
    assert dict(zip(evidence.classes[0].tolist(), evidence.weights[0].tolist(), strict=True)) == {4: 58, 10: 33, 0: 8}


def test_a_vote_from_a_label_edge_counts_less():
    semantic = np.full((10, 20), 11, np.uint8)
    semantic[:, :10] = 4
    image = PanopticImage(semantic, np.zeros((10, 20), np.int32), SIZE)
    xyz = np.array([[10, 0.1, 0], [10, 8.5, 0]], np.float32)  # pixels 9 and 1 of 20, the edge is at 10
    _, _, evidence = primal_labels(xyz, [(image, FORWARD, K)], Weighing(near=0))
    assert evidence.classes[:, 0].tolist() == [4, 4]
    assert evidence.weights[0, 0] == 50
    assert evidence.weights[1, 0] == 100


def test_points_near_the_camera_are_many_and_count_less_each():
    xyz = np.array([[4, 0, 0], [8, 0, 0], [80, 0, 0]], np.float32)
    weights = primal_labels(xyz, [(painted(4, 1), FORWARD, K)], Weighing(occlusion=None))[2].weights[:, 0]
    assert weights.tolist() == [20, 50, 99]


def test_no_points_no_cameras():
    assert primal_labels(np.zeros((0, 3), np.float32), [(painted(4, 1), FORWARD, K)])[2].classes.shape == (0, 3)
    evidence = primal_labels(np.ones((2, 3), np.float32), [])[2]
    assert not evidence.weights.any() and not evidence.cameras.any() and evidence.agree.all()
