"""HDBSCAN: the exact tree, the package's clusters, and no trace of threads or of the points' order."""

import threading

import hdbscan
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from l3ps_cluster import HDBSCAN, _core

SEEDS = st.integers(0, 2**32 - 1)


def street(rng, count):
    """Ground, a few objects on it and stray points: densities of several kinds."""
    ground = rng.uniform(-30, 30, (count, 3)) * [1, 1, 0.001]
    objects = rng.uniform(-30, 30, (12, 3))[rng.integers(0, 12, count)] * [1, 1, 0.05] + rng.normal(0, 0.4, (count, 3))
    return np.concatenate([ground, objects, rng.uniform(-40, 40, (count // 20, 3))]).astype(np.float32)


def grid_blobs(seed, count):
    """Blobs of whole numbers so small that float32 computes every distance exactly."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(-700, 700, (4, 3))
    return np.clip(centres[rng.integers(0, 4, count)] + rng.normal(0, 90, (count, 3)), -999, 999).round()


@given(SEEDS, st.integers(2, 300), st.integers(1, 12))
@settings(deadline=None)
def test_the_tree_weighs_what_brute_force_finds(reference, seed, count, min_samples):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    found = HDBSCAN(5, min_samples=min_samples).fit(points).tree_weight_
    assert found == pytest.approx(reference.tree_weight(points, min_samples), rel=1e-6)


@given(SEEDS, st.integers(2, 60), st.integers(1, 12))
@settings(deadline=None)
def test_the_tree_is_as_light_where_many_distances_are_equal(reference, seed, count, min_samples):
    points = np.random.default_rng(seed).integers(0, 4, (count, 3)).astype(np.float32)
    found = HDBSCAN(5, min_samples=min_samples).fit(points).tree_weight_
    assert found == pytest.approx(reference.tree_weight(points, min_samples), rel=1e-6, abs=1e-9)


@given(SEEDS, st.integers(8, 44), st.integers(2, 7), st.integers(1, 7))
@settings(deadline=None)
def test_the_partition_is_that_of_brute_force_and_the_package(reference, seed, count, min_cluster_size, min_samples):
    points = grid_blobs(seed, count)
    distances = pdist(points)
    assume(len(np.unique(distances)) == len(distances))
    expected = reference.labels(points, min_cluster_size, min_samples)
    assert reference.same_partition(HDBSCAN(min_cluster_size, min_samples).fit_predict(points), expected)


@pytest.mark.parametrize("min_cluster_size", [2, 5, 30])
def test_the_package_makes_the_same_clusters_of_the_same_tree(reference, rng, min_cluster_size):
    model = HDBSCAN(min_cluster_size, 5, keep_tree=True).fit(street(rng, 4000))
    assert reference.same_partition(model.labels_, reference.labels_of_tree(*model.tree_, min_cluster_size))


def test_the_tree_weighs_what_the_package_s_exact_one_does(rng):
    points = street(rng, 3000)
    peer = hdbscan.HDBSCAN(5, approx_min_span_tree=False, gen_min_span_tree=True).fit(points)
    weight = peer.minimum_spanning_tree_.to_numpy()[:, 2].sum()
    assert HDBSCAN(5).fit(points).tree_weight_ == pytest.approx(weight, rel=1e-6)


def test_the_tree_connects_all_points_with_edges_of_its_weight(rng):
    points = street(rng, 500)
    model = HDBSCAN(5, keep_tree=True).fit(points)
    ends, weights = model.tree_
    assert ends.shape == (len(points) - 1, 2)
    assert (np.diff(weights) >= 0).all()
    assert weights.sum() == pytest.approx(model.tree_weight_)
    linked = np.arange(len(points))
    for a, b in ends:
        linked[linked == linked[a]] = linked[b]
    assert len(set(linked)) == 1


def test_the_result_does_not_depend_on_the_number_of_threads(rng):
    points = np.concatenate([street(rng, 20000), rng.integers(0, 9, (3000, 3)).astype(np.float32)])
    models = [HDBSCAN(5, threads=threads, keep_tree=True).fit(points) for threads in (1, 2, 3, 8)]
    for model in models[1:]:
        np.testing.assert_array_equal(model.labels_, models[0].labels_)
        np.testing.assert_array_equal(model.tree_[0], models[0].tree_[0])
        assert model.tree_weight_ == models[0].tree_weight_


@given(SEEDS, st.integers(2, 400))
@settings(deadline=None)
def test_the_order_of_the_points_decides_nothing_but_the_numbers(reference, seed, count):
    rng = np.random.default_rng(seed)
    points = street(rng, count)
    shuffled = rng.permutation(len(points))
    there = HDBSCAN(5).fit_predict(points)
    assert reference.same_partition(there[shuffled], HDBSCAN(5).fit_predict(points[shuffled]))


def test_clusters_are_numbered_in_the_order_of_their_first_points(rng):
    found = HDBSCAN(5).fit_predict(street(rng, 2000))
    used, first = np.unique(found[found >= 0], return_index=True)
    np.testing.assert_array_equal(used, np.arange(len(used)))
    assert (np.diff(first) > 0).all()


def test_min_samples_alone_changes_the_core_distance(reference, rng):
    points = street(rng, 300)
    for min_samples in (1, 4, 5, 9, 25):
        found = HDBSCAN(5, min_samples).fit(points).tree_weight_
        assert found == pytest.approx(reference.tree_weight(points, min_samples), rel=1e-6), min_samples


class EnoughError(Exception):
    pass


def test_what_cancel_raises_stops_the_work_and_comes_out(rng):
    asked = []

    def cancel():
        asked.append(threading.get_ident())
        raise EnoughError

    model = HDBSCAN(5, threads=1)
    with pytest.raises(EnoughError):
        model.fit(rng.normal(size=(400_000, 3)), cancel)
    assert asked == [threading.get_ident()], "asked once, in the calling thread"
    assert not hasattr(model, "labels_")


def test_other_threads_run_meanwhile_and_cancel_may_let_it_go_on(rng):
    points = rng.normal(size=(400_000, 3)).astype(np.float32)
    counted, over, seen = [0], threading.Event(), []

    def count():
        while not over.is_set():
            counted[0] += 1

    other = threading.Thread(target=count)
    other.start()
    try:
        found = HDBSCAN(5, threads=1).fit_predict(points, lambda: seen.append(counted[0]))
    finally:
        over.set()
        other.join()
    assert len(seen) >= 2
    assert all(np.diff(seen) > 100)
    np.testing.assert_array_equal(found, HDBSCAN(5, threads=2).fit_predict(points))


def test_the_result_does_not_depend_on_the_processor(rng):
    """The copy of the loops for any processor and the one for this one's."""
    points = street(rng, 5000)
    best = _core.instruction_set()
    expected = HDBSCAN(5, keep_tree=True).fit(points)
    try:
        assert _core.choose_instruction_set("baseline")
        found = HDBSCAN(5, keep_tree=True).fit(points)
    finally:
        assert _core.choose_instruction_set(best)
    assert not _core.choose_instruction_set("abacus")
    np.testing.assert_array_equal(found.labels_, expected.labels_)
    np.testing.assert_array_equal(found.tree_[0], expected.tree_[0])
    assert found.tree_weight_ == expected.tree_weight_
