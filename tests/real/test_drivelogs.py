"""The readers on real recordings."""

import tarfile
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard

from l3ps.drivelog import open_drive, opened, validate
from l3ps.drivelog.images import image_size
from l3ps.geometry import apply

pytestmark = pytest.mark.real

LOGS = {
    # name: format, scans by scene, cameras of each scene's first scan, warnings and errors by (code, severity)
    "nuscenes-one-keyframe": ("nuscenes", {"scene-0061": 1}, [6], set()),
    "urban-surround": ("nuscenes", {"scene-01": 3, "scene-02": 3}, [3, 6], set()),
    "kitti-raw": ("kitti-raw", {"2011_09_26_drive_0000_sync": 16}, [1], set()),
    "semantickitti": ("semantickitti", {"00": 10}, [1], {("no-images", "warning")}),
    "semantickitti-one-scan": ("semantickitti", {"08": 1}, [0], {("no-images", "error")}),
}


@pytest.fixture(params=LOGS)
def name(request) -> str:
    return request.param


@pytest.fixture
def log(name, real_data) -> Path:
    return real_data / "data" / name


def test_scenes_scans_and_cameras(name, log):
    drive = open_drive(log)
    layout, scans, cameras, problems = LOGS[name]
    assert drive.format == layout
    assert {scene.name: len(scene.scans) for scene in drive.scenes} == scans
    assert [len(scene.scans[0].cameras) for scene in drive.scenes] == cameras
    assert {(p.code, p.severity) for p in validate(drive)} == problems


def test_every_scan_and_truth_loads(log):
    for scene in open_drive(log).scenes:
        for scan in scene.scans:
            points = scan.load_points()
            assert 30_000 < len(points) < 130_000
            assert 0 < float(points.intensity.max()) <= 1
            if scan.load_truth is not None:
                truth = scan.load_truth()
                assert len(truth.semantic) == len(truth.instance) == len(points)
                assert truth.semantic.any()


def test_a_fair_share_of_the_points_falls_into_the_images(log):
    for scene in open_drive(log).scenes:
        for scan in scene.scans:
            xyz = scan.load_points().xyz
            for camera in scan.cameras:
                width, height = image_size(camera.path)
                assert cv2.imread(str(camera.path)).shape[:2] == (height, width)
                in_camera = apply(scan.lidar_to_camera(camera), xyz)
                in_camera = in_camera[in_camera[:, 2] > 1]
                pixels = in_camera @ camera.intrinsic.T
                uv = pixels[:, :2] / pixels[:, 2:]
                inside = ((uv > 1) & (uv < (width - 1, height - 1))).all(axis=1)
                assert 0.05 < inside.sum() / len(xyz) < 0.35, (scan.token, camera.channel)


def test_sensor_heights(real_data):
    """The surround log puts its ego frame into the LiDAR, so its calibration tells nothing."""
    heights = {name: open_drive(real_data / "data" / name).sensor_height for name in LOGS}
    assert heights["nuscenes-one-keyframe"] == pytest.approx(1.84, abs=0.01)
    assert heights["urban-surround"] is None
    assert heights["kitti-raw"] == heights["semantickitti"] == 1.73


def test_truth_of_the_one_keyframe(real_data):
    """Instances and their classes, counted in the recorded boxes' panoptic file."""
    truth = open_drive(real_data / "data/nuscenes-one-keyframe").scenes[0].scans[0].load_truth()
    assert set(np.unique(truth.semantic).tolist()) == {0, 1, 2, 3, 4, 5, 7, 8, 10}
    raw = np.load(next((real_data / "data/nuscenes-one-keyframe/panoptic").rglob("*.npz")))["data"]
    assert len(np.unique(truth.instance)) == len(np.unique(raw[truth.semantic > 0])) + 1


def test_which_semantickitti_truth_has_instances(real_data):
    without = open_drive(real_data / "data/semantickitti").scenes[0].scans[0].load_truth()
    complete = open_drive(real_data / "data/semantickitti-one-scan").scenes[0].scans[0].load_truth()
    assert not without.has_instances
    assert complete.has_instances
    named = complete.instance > 0
    # ids count from 1 in each class, so only class and id together name an object
    assert len(np.unique(complete.semantic[named].astype(int) * 1000 + complete.instance[named])) == 14


def test_poses_of_the_odometry_log_bring_walls_together(real_data):
    """In the world frame the first and last scan overlap far better than in their own frames."""
    scans = open_drive(real_data / "data/semantickitti").scenes[0].scans

    def voxels(scan, pose):
        xyz = apply(pose, scan.load_points().xyz)
        xyz = xyz[xyz[:, 2] > 0]  # without the ground, which fits under any forward motion
        return {tuple(v) for v in np.floor(xyz / 0.3).astype(int).tolist()}

    fixed = voxels(scans[0], scans[0].ego_to_world)
    moved = voxels(scans[9], scans[9].ego_to_world)
    unmoved = voxels(scans[9], np.eye(4))
    assert len(fixed & moved) > 1.5 * len(fixed & unmoved)


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz", "tar.zst"])
def test_the_same_log_from_an_archive(real_data, tmp_path, kind):
    source = real_data / "data/urban-surround"
    archive = tmp_path / f"drive.{kind}"
    if kind == "zip":
        with zipfile.ZipFile(archive, "w") as out:
            for path in source.rglob("*"):
                out.write(path, Path("wrapped") / path.relative_to(source))
    else:
        with tarfile.open(archive, "w:gz" if kind == "tar.gz" else "w") as out:
            out.add(source, "wrapped")
        if kind == "tar.zst":
            archive.write_bytes(zstandard.ZstdCompressor().compress(archive.read_bytes()))
    plain = open_drive(source)
    with opened(archive, tmp_path / "scratch") as drive:
        assert validate(drive) == []
        for scene, other in zip(plain.scenes, drive.scenes, strict=True):
            assert [s.token for s in scene.scans] == [s.token for s in other.scans]
            np.testing.assert_array_equal(scene.scans[0].load_points().xyz, other.scans[0].load_points().xyz)
    assert not list((tmp_path / "scratch").iterdir())
