"""Whose poses real recordings are accumulated by; as published they equal those that were recorded."""

from dataclasses import replace

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.presets import BEST, PAPER
from l3ps.refine.poses import PoseTracker

pytestmark = pytest.mark.real


def tracked(scene, preset):
    tracker = PoseTracker(scene, preset)
    for scan in scene.scans:
        tracker.add(scan.load_points())
    return tracker.motion()


@pytest.mark.parametrize(
    ("log", "scene", "golden"),
    [("kitti-raw", 0, "kitti-raw-frames-0-3"), ("urban-surround", 1, "urban-surround-scene-02")],
)
def test_published_poses(real_data, log, scene, golden):
    whole = open_drive(real_data / "data" / log).scenes[scene]
    with np.load(real_data / "golden" / f"{golden}.npz") as archive:
        poses = archive["poses"]
    result = tracked(replace(whole, scans=whole.scans[: len(poses)]), PAPER)
    np.testing.assert_allclose(result.poses, poses, rtol=0, atol=1e-12)
    assert result.problems == ()


@pytest.mark.parametrize(
    ("log", "scene", "source", "problems"),
    [
        ("urban-surround", 0, "log", []),
        ("urban-surround", 1, "log", []),
        ("kitti-raw", 0, "kiss-icp", []),
        # Under its own poses neighbouring scans lie a fifth further apart than under KISS-ICP's.
        ("semantickitti", 0, "kiss-icp", ["inconsistent-poses"]),
    ],
)
def test_the_poses_that_the_scans_agree_with(real_data, log, scene, source, problems):
    whole = open_drive(real_data / "data" / log).scenes[scene]
    result = tracked(whole, BEST)
    assert (result.source, result.starts) == (source, (0,))
    assert [problem.code for problem in result.problems] == problems
    assert np.nanmin(result.overlap) > 0.5


def test_two_recordings_in_one_scene_are_told_apart(real_data):
    one, other = (open_drive(real_data / "data" / log).scenes[0] for log in ("kitti-raw", "urban-surround"))
    joined = tuple(replace(scan, ego_to_world=None) for scan in (*one.scans[:4], *other.scans[:3]))
    assert tracked(replace(one, scans=joined), BEST).starts == (0, 4)
