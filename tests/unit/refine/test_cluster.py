"""Clusters: partitions stay apart, noise finds a home, odd sizes do no harm."""

import numpy as np
import pytest

from l3ps.errors import Cancelled
from l3ps.refine.cluster import NOISE, cluster_scene, exact_hdbscan, hdbscan_package, reassign_noise


def blob(rng, centre, count=60, spread=0.2):
    return (np.asarray(centre) + rng.normal(0, spread, (count, 3))).astype(np.float32)


def test_distant_blobs_are_clusters_of_their_own_and_nothing_is_noise(rng):
    points = np.concatenate([blob(rng, (0, 0, 0)), blob(rng, (20, 0, 0)), blob(rng, (0, 20, 0))])
    labels, _ = cluster_scene(points, np.zeros(180, bool), 5)
    groups = [set(labels[i : i + 60]) for i in (0, 60, 120)]
    assert NOISE not in labels
    assert not groups[0] & groups[1]
    assert not groups[1] & groups[2]


def test_ground_and_object_never_share_a_cluster_even_where_they_touch(rng):
    points = np.concatenate([blob(rng, (0, 0, 0), 200), blob(rng, (0, 0, 0), 200)])
    ground = np.repeat([True, False], 200)
    labels, _ = cluster_scene(points, ground, 5)
    assert not set(labels[ground]) & set(labels[~ground])


@pytest.mark.parametrize("count", [0, 1, 2, 5, 6])
def test_tiny_partitions_are_left_alone_or_clustered_but_never_fail(rng, count):
    labels, _ = cluster_scene(blob(rng, (0, 0, 0), count), np.zeros(count, bool), 5)
    assert labels.shape == (count,)


def test_identical_points_do_not_fail():
    labels, _ = cluster_scene(np.zeros((50, 3), np.float32), np.zeros(50, bool), 5)
    assert len(set(labels)) == 1


def test_noise_takes_the_majority_of_its_three_nearest():
    points = np.array([[0, 0, 0], [1, 0, 0], [2.5, 0, 0], [2.9, 0, 0], [2.7, 0, 0]], np.float32)
    labels = np.array([0, 0, 1, 1, NOISE], np.int32)
    assert reassign_noise(points, labels).tolist() == [0, 0, 1, 1, 1]


def test_noise_with_three_different_neighbours_takes_the_lowest_id():
    points = np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0], [0.1, 1.4, 0]], np.float32)
    assert reassign_noise(points, np.array([2, 1, 0, NOISE], np.int32))[3] == 0


def test_all_noise_stays_noise():
    labels = np.full(4, NOISE, np.int32)
    assert reassign_noise(np.zeros((4, 3), np.float32), labels).tolist() == [NOISE] * 4


def test_cells_stand_for_their_points(rng):
    points = np.concatenate([blob(rng, (0, 0, 0), 500), blob(rng, (30, 0, 0), 500)])
    labels, _ = cluster_scene(points, np.zeros(1000, bool), 5, voxel=0.1)
    assert not set(labels[:500]) & set(labels[500:])


@pytest.mark.parametrize("clusterer", [exact_hdbscan, hdbscan_package])
def test_clustering_has_the_published_parameters(rng, clusterer):
    points = np.concatenate([blob(rng, (i * 10, 0, 0), 4) for i in range(5)])
    assert len(set(clusterer(points, 3, 1)) - {NOISE}) == 5, "s = 3 finds groups of 4"
    assert len(set(clusterer(points, 5, 1)) - {NOISE}) < 5, "s = 5 does not"


def test_the_core_clusters_unless_another_is_asked_for(rng):
    points = np.concatenate([blob(rng, centre, spread=2) for centre in ((0, 0, 0), (9, 0, 0), (0, 9, 0))])
    asked = []

    def one_cluster(part, size, threads):
        asked.append((len(part), size, threads))
        return np.zeros(len(part), np.int32)

    ground = points[:, 2] < 0
    assert (cluster_scene(points, ground, 5)[0] == cluster_scene(points, ground, 5, clusterer=exact_hdbscan)[0]).all()
    assert (cluster_scene(points, ground, 5, threads=3, clusterer=one_cluster)[0] == ground).all()
    assert asked == [((~ground).sum(), 5, 3), (ground.sum(), 5, 3)]


def test_what_cancel_raises_ends_the_clustering(rng):
    def cancel():
        raise Cancelled

    with pytest.raises(Cancelled):
        cluster_scene(blob(rng, (0, 0, 0), 400_000), np.zeros(400_000, bool), 5, threads=1, cancel=cancel)
