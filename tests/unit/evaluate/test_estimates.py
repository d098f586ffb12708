"""Quality without truth: what the figures say of labels whose quality is known."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from l3ps.evaluate import estimate_scans, rank_correlation, seen_twice

CAR, ROAD, MANMADE = 4, 11, 15
SCANS, SIZE = 6, 3000


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def scene(rng, *, wrong=(0.0,) * SCANS, impure=(0.0,) * SCANS):
    """The same street in every scan: a car every 3 m on a road; each cluster is one metre of it in one scan.

    ``wrong`` is a scan's share of cells whose refined class is wrong, ``impure`` of its votes that are for another.
    """
    bounds = np.arange(SCANS + 1) * SIZE
    points, cluster, primal, refined = [], [], [], []
    for scan in range(SCANS):
        x = rng.uniform(0, 30, SIZE)
        points.append(np.column_stack([x, rng.uniform(0, 1, SIZE), np.zeros(SIZE)]))
        cell = x.astype(int)
        true = np.where(cell % 3 == 0, CAR, ROAD)
        spoilt = np.isin(cell, rng.permutation(30)[: round(30 * wrong[scan])])
        refined.append(np.where(spoilt, MANMADE, true))
        primal.append(np.where(rng.random(SIZE) < impure[scan], MANMADE, true))
        cluster.append(30 * scan + cell)
    return (
        [f"scan{scan}" for scan in range(SCANS)],
        bounds,
        np.concatenate(points).astype(np.float32),
        np.concatenate(cluster).astype(np.int32),
        np.concatenate(primal).astype(np.uint8),
        np.concatenate(refined).astype(np.uint8),
    )


def test_perfect_labels_have_a_perfect_estimate(rng):
    for estimate in estimate_scans(*scene(rng)):
        assert estimate.purity == 1
        assert estimate.consistency > 0.95, "cells reach over the edge of a car"
        assert estimate.estimate > 0.95
        assert estimate.unvoted == 0
        assert estimate.cameras is None


def test_scans_rank_by_the_share_of_wrong_cells(rng):
    wrong = (0.3, 0.0, 0.0, 0.1, 0.0, 0.2)
    estimates = estimate_scans(*scene(rng, wrong=wrong))
    assert [e.estimate for e in estimates].index(min(e.estimate for e in estimates)) == 0
    assert rank_correlation([e.consistency for e in estimates], [-w for w in wrong]) > 0.8
    for estimate, share in zip(estimates, wrong, strict=True):
        assert estimate.consistency == pytest.approx(1 - share, abs=0.1)


def test_scans_rank_by_how_clusters_voted(rng):
    impure = (0.3, 0.0, 0.4, 0.1, 0.2, 0.05)
    estimates = estimate_scans(*scene(rng, impure=impure))
    assert rank_correlation([e.estimate for e in estimates], [-i for i in impure]) == pytest.approx(1)
    assert [e.purity for e in estimates] == pytest.approx([1 - i for i in impure], abs=0.05)


def test_a_scan_is_not_its_own_witness(rng):
    """Alone in its place it has no support, and its consistency is unknown rather than perfect."""
    tokens, bounds, points, *rest = scene(rng)
    points[bounds[2] : bounds[3]] += 500
    lonely = estimate_scans(tokens, bounds, points, *rest)[2]
    assert (lonely.support, lonely.consistency, lonely.thing_consistency) == (0, None, None)
    assert lonely.estimate == 0


def test_a_scene_of_one_scan_is_judged_by_its_votes_alone(rng):
    tokens, bounds, *arrays = scene(rng, impure=(0.2,) * SCANS)
    (alone,) = estimate_scans(tokens[:1], bounds[:2], *(array[:SIZE] for array in arrays))
    assert (alone.support, alone.consistency) == (None, None)
    assert alone.estimate == alone.purity == pytest.approx(0.8, abs=0.05)


def test_points_that_no_camera_saw_are_told(rng):
    tokens, bounds, points, cluster, primal, refined = scene(rng)
    own = slice(bounds[1], bounds[2])
    primal[own][points[own, 0] < 15] = 0
    estimates = estimate_scans(tokens, bounds, points, cluster, primal, refined)
    assert estimates[1].unvoted == pytest.approx(0.5, abs=0.05)
    assert estimates[1].purity == 1, "clusters without a vote are not impure"
    assert estimates[0].unvoted == 0


def test_agreement_of_cameras_counts_only_points_that_two_saw(rng):
    inputs = scene(rng)
    agree = np.full(SCANS * SIZE, -1, np.int8)
    agree[:100] = 1
    agree[100:200] = 0
    cameras = np.where(agree >= 0, 2, 1).astype(np.uint8)
    estimates = estimate_scans(*inputs, seen_twice(cameras, agree != 0))
    assert estimates[0].cameras == 0.5
    assert estimates[1].cameras is None


def test_what_the_labels_say_of_themselves_counts_a_class_each(rng):
    """Cars are a third of the points and half of the figure."""
    tokens, bounds, points, cluster, primal, refined = scene(rng)
    certain = np.full(SCANS * SIZE, 255, np.uint8)
    doubtful = certain.copy()
    doubtful[: bounds[1]][refined[: bounds[1]] == CAR] = 51
    sure = estimate_scans(tokens, bounds, points, cluster, primal, refined, confidence=certain)
    unsure = estimate_scans(tokens, bounds, points, cluster, primal, refined, confidence=doubtful)
    assert sure[0].confidence == 1
    assert unsure[0].confidence == pytest.approx((0.2 + 1) / 2)
    assert unsure[0].estimate < sure[0].estimate
    assert unsure[1] == sure[1]


def test_scans_without_points_labels_or_clusters_are_unknown():
    nothing = estimate_scans(
        ["a", "b"],
        np.array([0, 0, 40]),
        np.full((40, 3), np.nan, np.float32),
        np.full(40, -1, np.int32),
        np.zeros(40, np.uint8),
        np.zeros(40, np.uint8),
    )
    for estimate in nothing:
        assert {value for key, value in estimate.as_dict().items() if key != "token"} == {None}


@pytest.mark.parametrize("seed", range(5))
def test_rank_correlation_is_spearmans(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, 6, 20).astype(float), rng.normal(size=20)
    assert rank_correlation(a.tolist(), b.tolist()) == pytest.approx(spearmanr(a, b).statistic)


def test_rank_correlation_of_too_little_is_unknown():
    assert rank_correlation([1.0, 2.0, None], [1.0, 2.0, 3.0]) is None
    assert rank_correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is None
