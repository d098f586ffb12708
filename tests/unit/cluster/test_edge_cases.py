"""Inputs that are few, alike, far out or wrong."""

import numpy as np
import pytest

from l3ps_cluster import HDBSCAN, fill_noise, link, nearest


@pytest.mark.parametrize("count", range(6))
def test_no_more_points_than_a_cluster_needs_are_noise(rng, count):
    """From none at all to min_cluster_size."""
    model = HDBSCAN(5, keep_tree=True).fit(rng.normal(size=(count, 3)))
    assert model.labels_.tolist() == [-1] * count
    assert model.tree_[0].shape == (max(count - 1, 0), 2)


def test_a_single_point_has_a_tree_without_weight():
    """One point."""
    assert HDBSCAN(5).fit(np.ones((1, 3))).tree_weight_ == 0


def test_two_points_weigh_their_distance():
    """Fewer neighbours than min_samples: the farthest there is counts."""
    assert HDBSCAN(5).fit(np.array([[0, 0, 0], [3, 4, 0]])).tree_weight_ == 5


def test_more_min_samples_than_points_are_taken_for_all(reference, rng):
    """min_samples > n."""
    points = rng.normal(size=(20, 3)).astype(np.float32)
    assert HDBSCAN(5, 1000).fit(points).tree_weight_ == pytest.approx(reference.tree_weight(points, 19), rel=1e-6)


def test_min_cluster_size_above_the_number_of_points_is_all_noise(rng):
    """min_cluster_size > n."""
    assert set(HDBSCAN(1000).fit_predict(rng.normal(size=(300, 3)))) == {-1}


def test_copies_of_one_point_are_no_clusters():
    """All duplicates: nothing splits, and the root is no cluster; 40,000 of them take no quadratic time."""
    model = HDBSCAN(5).fit(np.full((40_000, 3), 7.5))
    assert set(model.labels_) == {-1}
    assert model.tree_weight_ == 0


def test_places_of_many_copies_each_are_clusters(rng):
    """Duplicates merge at once, not in an order that splits them: lambda is infinite there."""
    places = rng.normal(size=(200, 3)).astype(np.float32)
    labels = HDBSCAN(5).fit_predict(np.repeat(places, 50, axis=0))
    np.testing.assert_array_equal(labels, np.repeat(np.arange(200), 50))


def test_points_on_a_line_have_a_tree(reference, rng):
    """Collinear, evenly spaced: every distance is tied."""
    points = np.outer(np.arange(500), [1.0, 0, 0]).astype(np.float32)
    assert HDBSCAN(5).fit(points).tree_weight_ == pytest.approx(reference.tree_weight(points, 5), rel=1e-6)


def test_utm_coordinates_keep_their_digits(rng):
    """Huge coordinates in float64: 5e5 east, 4e6 north, as if the scene were at the origin."""
    points = (rng.uniform(-50, 50, (3000, 3)) / 2**-10).round() * 2**-10
    there = points + np.array([500_000, 4_000_000, 100])
    here = HDBSCAN(5).fit(points)
    moved = HDBSCAN(5).fit(there)
    assert moved.tree_weight_ == pytest.approx(here.tree_weight_, rel=1e-6)
    assert (moved.labels_ == here.labels_).mean() > 0.99


@pytest.mark.parametrize("size", [1e-30, 1e-12, 1e12, 1e14])
def test_any_unit_will_do(rng, size):
    """Squares that float32 cannot hold."""
    points = rng.normal(size=(500, 3)).astype(np.float32)
    scaled = HDBSCAN(5).fit(points.astype(np.float64) * size).tree_weight_
    assert scaled == pytest.approx(HDBSCAN(5).fit(points).tree_weight_ * size, rel=1e-5)
    assert np.isfinite(nearest(points * np.float32(size), points[:5] * np.float32(size))[0]).all()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("call", [HDBSCAN(5).fit, lambda p: nearest(p, p), lambda p: link(p, 1)])
def test_coordinates_that_are_no_numbers_are_refused(rng, wrong, call):
    """NaN and infinity, in a sentence that says what is wrong."""
    points = rng.normal(size=(100, 3))
    points[70, 1] = wrong
    with pytest.raises(ValueError, match="every coordinate must be a finite number"):
        call(points)


@pytest.mark.parametrize("shape", [(30,), (10, 4), (10, 1), (2, 5, 3)])
def test_another_shape_is_refused(shape):
    """Rows of three; the functions besides HDBSCAN take two as well."""
    with pytest.raises(ValueError, match=r"points: expected an array of shape \(N, 3\)"):
        HDBSCAN(5).fit(np.zeros(shape))
    with pytest.raises(ValueError, match=r"points: expected an array of shape \(N, 2\) or \(N, 3\)"):
        link(np.zeros(shape), 1)


@pytest.mark.parametrize("dtype", [complex, object, "U5", bool])
def test_what_is_no_real_number_is_refused(dtype):
    """Wrong dtype."""
    with pytest.raises(TypeError, match="points: expected real numbers"):
        HDBSCAN(5).fit(np.zeros((9, 3)).astype(dtype))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int32, np.uint8])
def test_any_real_type_is_taken(rng, dtype):
    """Converted where it is neither float32 nor float64."""
    points = rng.integers(0, 100, (300, 3))
    expected = HDBSCAN(5).fit(points.astype(np.float32)).tree_weight_
    assert HDBSCAN(5).fit(points.astype(dtype)).tree_weight_ == pytest.approx(expected, rel=1e-6)


def test_strided_points_are_taken(rng):
    """Not contiguous, Fortran order, reversed, read-only: the same labels."""
    wide = rng.normal(size=(600, 7)).astype(np.float32)
    points = np.ascontiguousarray(wide[:, 1:4])
    expected = HDBSCAN(5).fit_predict(points)
    frozen = points.copy()
    frozen.setflags(write=False)
    for view in (wide[:, 1:4], np.asfortranarray(points), points[::-1][::-1], frozen, points.tolist()):
        np.testing.assert_array_equal(HDBSCAN(5).fit_predict(view), expected)


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        ({"min_cluster_size": 1}, ValueError, "min_cluster_size: expected 2 or more, not 1"),
        ({"min_cluster_size": 5.0}, TypeError, "min_cluster_size: expected a whole number"),
        ({"min_samples": 0}, ValueError, "min_samples: expected 1 or more, not 0"),
        ({"threads": 0}, ValueError, "threads: expected 1 or more, not 0"),
        ({"threads": True}, TypeError, "threads: expected a whole number"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, error, message):
    """Said when fitting, as scikit-learn's estimators do."""
    with pytest.raises(error, match=message):
        HDBSCAN(**parameters).fit(np.zeros((10, 3)))


def test_the_functions_refuse_what_they_cannot_use():
    """Gap, reach, k, labels and queries out of range."""
    points = np.zeros((4, 3), np.float32)
    for call, message in [
        (lambda: link(points, -1.0), "gap: expected a finite number of 0 or more"),
        (lambda: link(points, np.nan), "gap: expected a finite number of 0 or more"),
        (lambda: nearest(points, points, 0), "k: expected 1 or more, not 0"),
        (lambda: nearest(points, points[:, :2]), "queries: expected 3 coordinates as the points have, not 2"),
        (lambda: nearest(points, points, max_distance=np.nan), "max_distance: expected 0 or more"),
        (lambda: fill_noise(points, np.zeros(3, int)), r"labels: expected shape \(4,\) as there are points"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="labels: expected whole numbers"):
        fill_noise(points, np.zeros(4))


def test_coordinates_that_float_cannot_hold_beside_others_are_refused(rng):
    """One point at 1e30 among others crashed the search for neighbours."""
    points = rng.random((1000, 3)).astype(np.float32)
    points[0] = 1e30
    labels = np.where(np.arange(1000) % 2, -1, 7)
    for call in (
        lambda: fill_noise(points, labels),
        lambda: HDBSCAN().fit(points),
        lambda: link(points, 0.1),
        lambda: nearest(points, points[1:]),
    ):
        with pytest.raises(ValueError, match="finite number below 1e15"):
            call()


def test_a_count_beyond_what_there_can_be_is_refused():
    with pytest.raises(ValueError, match="less than 2\\^31"):
        HDBSCAN(min_cluster_size=2**40).fit(np.zeros((10, 3), np.float32))
