"""Clusters of three real recordings, beside those of the hdbscan package and the recorded ones."""

import hdbscan
import numpy as np
import pytest
from hdbscan._hdbscan_linkage import label
from hdbscan.hdbscan_ import _tree_to_labels
from scipy.spatial import cKDTree
from sklearn.metrics import adjusted_rand_score

from l3ps.refine.cluster import NOISE, reassign_noise
from l3ps_cluster import HDBSCAN, fallback

LOGS = ("kitti-raw-frames-0-3", "nuscenes-one-keyframe", "urban-surround-scene-02")
pytestmark = pytest.mark.real


@pytest.fixture(scope="module", params=LOGS)
def golden(request, real_data):
    with np.load(real_data / "golden" / f"{request.param}.npz") as archive:
        return {name: archive[name] for name in ("points", "ground", "cluster", "noise")}


def exact_package(points):
    """The package with its exact tree: by default it stops short of the minimum, by 1 % of the weight on one scan."""
    return hdbscan.HDBSCAN(5, approx_min_span_tree=False, gen_min_span_tree=True, core_dist_n_jobs=1).fit(points)


@pytest.mark.slow
def test_clusters_differ_from_the_package_s_no_more_than_its_own_do_when_points_change_places(golden):
    """Edges that weigh one point's core distance tie, and the package merges them in any order: shuffle the points, and
    one in twenty-five goes elsewhere. Beyond that the clusters are the same."""
    points, ground = golden["points"], golden["ground"].astype(bool)
    for part in (points[ground][:60_000], points[~ground][:60_000]):
        order = np.random.default_rng(1).permutation(len(part))
        package, shuffled = exact_package(part), exact_package(part[order])
        to_itself = adjusted_rand_score(package.labels_[order], shuffled.labels_)
        ours = HDBSCAN(5).fit(part)
        assert ours.tree_weight_ == pytest.approx(package._min_spanning_tree[:, 2].sum(), rel=1e-6)
        assert adjusted_rand_score(package.labels_, ours.labels_) > to_itself - 0.02
        ours_shuffled = HDBSCAN(5).fit_predict(part[order])
        assert adjusted_rand_score(ours.labels_[order], ours_shuffled) > 0.99, "only exact ties of distance are left"


def test_the_package_makes_the_same_clusters_of_the_same_tree(golden):
    points, ground = golden["points"], golden["ground"].astype(bool)
    for part in (points[ground], points[~ground]):
        ours = HDBSCAN(5, keep_tree=True).fit(part)
        ends, weights = ours.tree_
        package = _tree_to_labels(None, label(np.column_stack([ends.astype(np.float64), weights])), 5)[0]
        assert adjusted_rand_score(package, ours.labels_) == 1.0
        np.testing.assert_array_equal(package < 0, ours.labels_ < 0)


def test_noise_is_reassigned_as_scipy_does_it(golden):
    """Every point that was noise, given the recorded clusters of the others, save where the third is as near as the
    fourth."""
    points = golden["points"]
    labels = np.where(golden["noise"].astype(bool), NOISE, golden["cluster"]).astype(np.int32)
    noise = labels == NOISE
    assert noise.sum() > 1000
    distance, _ = cKDTree(points[~noise]).query(points[noise], k=4, workers=2)
    clear = np.ones(len(points), dtype=bool)
    clear[np.flatnonzero(noise)[distance[:, 2] == distance[:, 3]]] = False
    expected = fallback.fill_noise(points, labels, 3, 2)
    np.testing.assert_array_equal(reassign_noise(points, labels)[clear], expected[clear])
