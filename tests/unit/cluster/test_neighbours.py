"""Nearest neighbours, links and the filling of noise, against SciPy and against each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps_cluster import fallback, fill_noise, link, nearest

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.integers(1, 400), st.integers(0, 100), st.integers(1, 12), st.sampled_from([2, 3]))
@settings(deadline=None)
def test_nearest_are_those_of_scipy(seed, count, queries, k, dimensions):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, dimensions)).astype(np.float32)
    asked = rng.normal(size=(queries, dimensions)).astype(np.float32)
    distance, index = nearest(points, asked, k)
    expected, at = fallback.nearest(points, asked, k, np.inf, 1)
    np.testing.assert_allclose(distance, expected, rtol=1e-6)
    np.testing.assert_array_equal(index, at)


def test_nothing_farther_than_the_limit_is_found():
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    distance, index = nearest(points, points[:1], 3, max_distance=1)
    assert distance.tolist() == [[0, 1, np.inf]]
    assert index.tolist() == [[0, 1, -1]]


def test_without_points_nothing_is_near():
    distance, index = nearest(np.zeros((0, 3)), np.zeros((2, 3)), 2)
    assert np.isinf(distance).all()
    assert (index == -1).all()


def test_queries_and_points_keep_their_digits_together(rng):
    points = rng.uniform(-20, 20, (500, 3)) + np.array([500_000, 4_000_000, 0])
    distance, index = nearest(points, points + np.array([0.001, 0, 0]))
    np.testing.assert_array_equal(index[:, 0], np.arange(500))
    np.testing.assert_allclose(distance, 0.001, atol=1e-5)


def chains(labels):
    """The labels renumbered, so that two labellings are equal where their groups are."""
    _, first, number = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]


@given(SEEDS, st.integers(0, 600), st.floats(0, 0.5), st.sampled_from([2, 3]))
@settings(deadline=None)
def test_links_are_those_of_all_pairs(seed, count, gap, dimensions):
    points = np.random.default_rng(seed).uniform(size=(count, dimensions)).astype(np.float32)
    np.testing.assert_array_equal(link(points, gap), fallback.link(points, gap))


@given(SEEDS, st.integers(1, 300), st.integers(0, 3))
@settings(deadline=None)
def test_a_step_of_exactly_the_gap_links(seed, count, gap):
    points = np.random.default_rng(seed).integers(0, 12, (count, 3)).astype(np.float32)
    np.testing.assert_array_equal(link(points, gap), fallback.link(points, gap))


def test_components_are_numbered_in_the_order_of_their_first_points(rng):
    found = link(rng.uniform(size=(3000, 2)), 0.012)
    np.testing.assert_array_equal(found, chains(found))


def test_a_crowd_within_the_gap_is_one_component_without_its_pairs(rng):
    """200,000 points within one gap: 2e10 pairs would neither fit nor end."""
    crowd = rng.uniform(0, 0.3, (200_000, 2))
    found = link(np.concatenate([crowd, crowd + np.array([5, 0])]), 0.7)
    np.testing.assert_array_equal(found, np.repeat([0, 1], 200_000))


def test_two_crowds_just_too_far_apart_stay_two(rng):
    wall = rng.uniform(size=(60_000, 3)).astype(np.float32) * [0, 30, 3]
    points = np.concatenate([wall, wall + np.array([0.5, 0, 0])]).astype(np.float32)
    np.testing.assert_array_equal(link(points, 0.4999), np.repeat([0, 1], 60_000))
    assert link(points, 0.5001).max() == 0


@given(SEEDS, st.integers(1, 300), st.integers(1, 6))
@settings(deadline=None)
def test_noise_is_filled_as_scipy_fills_it(seed, count, k):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    labels = rng.integers(-1, 4, count).astype(np.int32)
    np.testing.assert_array_equal(fill_noise(points, labels, k), fallback.fill_noise(points, labels, k, 1))


def test_of_equally_near_points_the_first_ones_count():
    """Eight corners of a cube around a noise point: the three of lowest index decide."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    points = np.concatenate([np.zeros((1, 3), np.float32), corners])
    for labels, expected in [
        ([5, 5, 9, 9, 9, 9, 9, 9], 5),
        ([9, 5, 5, 9, 9, 9, 9, 9], 5),
        ([8, 7, 6, 6, 6, 6, 6, 6], 6),
    ]:
        assert fill_noise(points, np.array([-1, *labels]))[0] == expected


def test_distances_that_float32_cannot_tell_apart_are_compared_in_float64():
    """The third and the fourth nearest differ by less than float32's last digit."""
    far = np.float32(1.0)
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [far, 1e-4, 0], [far, 0, 0]], np.float32)
    labels = np.array([-1, 1, 2, 2, 1], np.int32)
    squares = (points[1:].astype(np.float32) ** 2).sum(axis=1)
    assert squares[2] == squares[3], "the premise"
    assert fill_noise(points, labels)[0] == 1


def test_labels_stay_where_nothing_is_noise_or_all_is(rng):
    points = rng.normal(size=(10, 3))
    for labels in (np.arange(10), np.full(10, -1)):
        np.testing.assert_array_equal(fill_noise(points, labels), labels)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(rng, threads):
    points = rng.normal(size=(20_000, 3)).astype(np.float32)
    labels = rng.integers(-1, 50, 20_000)
    for call in (lambda t: nearest(points, points, 4, threads=t)[1], lambda t: link(points, 0.05, threads=t)):
        np.testing.assert_array_equal(call(threads), call(2))
    np.testing.assert_array_equal(fill_noise(points, labels, threads=threads), fill_noise(points, labels, threads=2))
