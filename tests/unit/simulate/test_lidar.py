"""The LiDAR is as imperfect as a real one, and no more."""

import numpy as np

from l3ps.simulate.lidar import BEAMS, MAX_RANGE, sweep
from l3ps.simulate.street import meet_ground


def test_some_returns_are_lost_and_more_of_them_far_away(world):
    scan = sweep(world, 1.0, np.random.default_rng(0))
    met = scan.ranges < MAX_RANGE
    beams = scan.points[:, 4].astype(int)
    assert set(np.unique(beams)) <= set(range(BEAMS))
    assert 20_000 < len(scan.points) < met.sum()
    measured = np.linalg.norm(scan.points[:, :3], axis=1)
    kept_near = (measured < 15).sum() / (scan.ranges < 15).sum()
    kept_far = ((measured > 45) & (measured < MAX_RANGE)).sum() / ((scan.ranges > 45) & met).sum()
    assert 0.95 < kept_near < 0.995
    assert kept_far < kept_near - 0.1


def test_ranges_are_noisy_by_centimetres(world):
    """The same instant scanned twice: bias-free, a few centimetres apart, never the same."""
    first, second = (sweep(world, 1.0, np.random.default_rng(seed)) for seed in (1, 2))
    ranges = [by_ray(scan) for scan in (first, second)]
    both = np.isfinite(ranges[0]) & np.isfinite(ranges[1]) & (first.actors < 0)
    difference = ranges[0][both] - ranges[1][both]
    assert 0.015 < np.std(difference) < 0.06
    assert abs(difference.mean()) < 0.002


def by_ray(scan):
    table = np.full(scan.ranges.shape, np.inf)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    column = np.floor(azimuth / (2 * np.pi) * scan.ranges.shape[1]).astype(int)
    table[scan.points[:, 4].astype(int), column] = np.linalg.norm(scan.points[:, :3], axis=1)
    return table


def test_the_ground_is_where_the_wheels_are(world):
    """Road points lie a sensor height below the LiDAR."""
    scan = sweep(world, 1.0, np.random.default_rng(0))
    road = (scan.raw == 24) & (np.linalg.norm(scan.points[:, :2], axis=1) < 10)
    assert road.sum() > 2000
    assert abs(np.median(scan.points[road, 2]) + 1.84) < 0.05


def test_nothing_floats_and_nothing_sinks(world):
    """Straight down from above an object the ground lies where the object stands."""
    for time in (0.0, 5.0):
        for pose in world.poses(time):
            above = np.array([*pose[:2, 3], 9.0])
            depth = meet_ground(world.street, above, np.array([[0.0], [0.0], [-1.0]], np.float32)).depth[0]
            assert abs(9.0 - depth - pose[2, 3]) < 1e-4


def test_crowds_give_panoptic_evaluation_something_to_do(world):
    """Many objects, several classes, most of them with enough returns to count."""
    scan = sweep(world, 1.0, np.random.default_rng(0))
    ids, counts = np.unique(scan.instance[scan.instance > 0], return_counts=True)
    assert (counts >= 15).sum() >= 20
    assert len(np.unique(world.semantic[np.isin(world.instance, ids[counts >= 15])])) >= 4
