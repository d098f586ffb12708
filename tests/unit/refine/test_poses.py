"""Whose poses a scene is accumulated by, and what happens where none can be trusted."""

from dataclasses import replace

import numpy as np
import pytest

from l3ps.drivelog.types import Points, Scan, Scene
from l3ps.geometry import invert, transform
from l3ps.presets import BEST, PAPER
from l3ps.refine.accumulate import transform as moved
from l3ps.refine.overlap import fit, standing
from l3ps.refine.poses import PoseTracker, log_steps

STEP, TURN = 0.8, 0.02
"""Metres forward and radians from scan to scan."""


def yaw(angle):
    return [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]


def motion(step=STEP, turn=TURN):
    return transform(yaw(turn), [step, 0, 0])


def place(seed):
    """Ground, walls and poles of a place of its own, (N, 3) float64 metres."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-60, 60, (9000, 2)), rng.normal(-1.7, 0.01, 9000)])
    parts = [ground]
    for centre in rng.uniform(-40, 40, (40, 2)):
        along = rng.uniform(-3, 3, 500)
        angle = rng.uniform(0, np.pi)
        wall = np.column_stack([along * np.cos(angle), along * np.sin(angle), rng.uniform(-1.7, 2, 500)])
        parts.append(wall + np.array([*centre, 0]))
    return np.concatenate(parts)


def drive(places=(0,) * 6, step=motion(), log=lambda index, pose: pose, seconds=0.1):
    """A scene whose scan i sees ``places[i]`` from the i-th pose along the path; ``log`` tells a scan's ego pose."""
    pose, scans, poses = np.eye(4), [], []
    for index, seed in enumerate(places):
        xyz = moved(place(seed).astype(np.float32), invert(pose))
        xyz += np.random.default_rng(index).normal(0, 0.01, xyz.shape).astype(np.float32)
        xyz[:5] = np.nan
        points = Points(xyz, np.full(len(xyz), 0.3, np.float32))
        stamp = round(index * seconds * 1e6)
        told = log(index, pose) if log else None
        scans.append(Scan(f"scan{index}", index, stamp, None, np.eye(4), told, (), lambda points=points: points))
        poses.append(pose)
        pose = pose @ step
    return Scene("street", tuple(scans)), np.stack(poses)


def tracked(scene, preset=BEST):
    tracker = PoseTracker(scene, preset)
    for scan in scene.scans:
        tracker.add(scan.load_points())
    return tracker.motion()


def codes(result):
    return [problem.code for problem in result.problems]


def test_the_logs_poses_are_taken_where_the_scans_agree_with_them():
    scene, poses = drive()
    result = tracked(scene)
    assert (result.source, result.starts, result.problems) == ("log", (0,), ())
    np.testing.assert_allclose(result.poses, poses, atol=1e-6)
    assert np.isnan(result.residual[0]) and (result.residual[1:] < 0.3).all()
    assert (result.overlap[1:] > 0.5).all()


def test_poses_far_from_the_origin_lose_nothing():
    """World coordinates as in UTM: 500 km east, 5,000 km north."""
    away = transform(np.eye(3), [5e5, 5e6, 100])
    scene, poses = drive(log=lambda index, pose: away @ pose)
    np.testing.assert_allclose(tracked(scene).poses, poses, atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda index, pose: np.eye(4), id="placeholders"),
        pytest.param(lambda index, pose: transform(np.eye(3), pose[:3, 3]), id="no-rotation"),
        pytest.param(lambda index, pose: transform(pose[:3, :3], 100 * pose[:3, 3]), id="centimetres"),
    ],
)
def test_poses_that_the_scans_contradict_are_reported_and_not_used(wrong):
    scene, poses = drive(step=motion(turn=0.06), log=wrong)
    result = tracked(scene)
    assert result.source == "kiss-icp"
    assert codes(result)[0] == "inconsistent-poses"
    assert result.starts == (0,)
    np.testing.assert_allclose(result.poses[:, :3, 3], poses[:, :3, 3], atol=0.15)


@pytest.mark.parametrize("bad", [None, np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1])])
def test_a_pose_that_is_missing_or_not_rigid_leaves_the_log_out(bad):
    scene, poses = drive(log=lambda index, pose: bad if index == 2 else pose)
    assert log_steps(scene) is None
    result = tracked(scene)
    assert (result.source, result.starts) == ("kiss-icp", (0,))
    np.testing.assert_allclose(result.poses[:, :3, 3], poses[:, :3, 3], atol=0.15)


def test_one_jump_of_the_logs_poses_is_mended_and_named():
    away = transform(np.eye(3), [0, 8, 0])
    scene, poses = drive((0,) * 10, log=lambda index, pose: away @ pose if index >= 5 else pose)
    result = tracked(scene)
    assert (result.source, result.starts, codes(result)) == ("log", (0,), ["pose-jump"])
    assert result.problems[0].scan == "scan5"
    np.testing.assert_allclose(result.poses[:, :3, 3], poses[:, :3, 3], atol=0.2)


@pytest.mark.parametrize("log", [None, lambda index, pose: pose])
def test_a_scene_that_continues_elsewhere_is_cut_there(log):
    """Two recordings in one: neither odometry nor poses can bring the second half onto the first."""
    scene, _ = drive((0, 0, 0, 0, 1, 1, 1, 1), log=log)
    result = tracked(scene)
    assert result.starts == (0, 4)
    assert codes(result) == ["odometry-failed"]
    assert (result.problems[0].scan, result.problems[0].severity) == ("scan4", "warning")
    inside = invert(result.poses[4]) @ result.poses[7]
    expected = np.linalg.matrix_power(motion(), 3)
    np.testing.assert_allclose(inside[:3, 3], expected[:3, 3], atol=0.15)


def test_as_published_nothing_is_cut_or_taken_from_the_log_but_failure_is_reported():
    scene, _ = drive((0, 0, 0, 1, 1, 1), log=lambda index, pose: pose)
    result = tracked(scene, PAPER)
    assert (result.source, result.starts) == ("kiss-icp", (0,))
    assert "odometry-failed" in codes(result)


def test_steps_of_many_metres_are_found_without_poses():
    """Keyframes at 2 Hz: KISS-ICP alone predicts that the second scan stands where the first stood."""
    scene, poses = drive(step=motion(step=6.0, turn=0.0), log=None, seconds=0.5)
    result = tracked(scene)
    assert result.problems == ()
    np.testing.assert_allclose(result.poses[:, :3, 3], poses[:, :3, 3], atol=0.3)


def test_where_nothing_stands_nothing_is_doubted():
    flat = np.column_stack([np.random.default_rng(0).uniform(-40, 40, (5000, 2)), np.full(5000, -1.7)])
    points = Points(flat.astype(np.float32), np.zeros(5000, np.float32))
    scene, _ = drive()
    field = replace(scene, scans=tuple(replace(scan, load_points=lambda: points) for scan in scene.scans))
    result = tracked(field)
    assert (result.source, result.starts, result.problems) == ("log", (0,), ())
    assert np.isnan(result.overlap).all()


def test_scenes_of_one_scan_and_of_none():
    scene, _ = drive((0,))
    one = tracked(scene)
    np.testing.assert_array_equal(one.poses, np.eye(4)[None])
    assert one.starts == (0,)
    assert tracked(Scene("empty", ())).poses.shape == (0, 4, 4)


def test_a_wrong_motion_fits_worse_the_more_it_is_wrong():
    scene, _ = drive((0, 0))
    one, other = (standing(scan.load_points().xyz) for scan in scene.scans)
    fits = [fit(one, other, transform(np.eye(3), [0, off, 0]) @ motion()) for off in (0, 0.3, 1, 3)]
    assert fits[0].residual < fits[1].residual < fits[2].residual
    assert fits[0].overlap > 0.8 > fits[1].overlap > fits[2].overlap > fits[3].overlap
