"""KITTI raw and SemanticKITTI logs."""

import math

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.errors import DriveLogError
from l3ps.geometry import apply, is_rigid

POINT = np.array([[10.0, 1.0, 0.5]])


def pixel(scan, camera):
    u, v, w = (apply(scan.lidar_to_camera(camera), POINT) @ camera.intrinsic.T)[0]
    return u / w, v / w


def test_raw_drives_are_scenes(kitti_raw_log):
    drive = open_drive(kitti_raw_log(drives=2, scans=3))
    assert (drive.format, drive.sensor_height, drive.problems) == ("kitti-raw", 1.73, ())
    assert [s.name for s in drive.scenes] == ["2011_09_26_drive_0000_sync", "2011_09_26_drive_0001_sync"]
    scan = drive.scenes[0].scans[1]
    assert scan.number == "0000000001"
    assert len({s.token for scene in drive.scenes for s in scene.scans}) == 6
    assert scan.timestamp == 1317042145_123456
    assert scan.cameras[0].size == (64, 48)
    np.testing.assert_array_equal(scan.lidar_to_ego, np.eye(4))


def test_raw_projection_is_p_r_t(kitti_raw_log):
    """The pixel of the formula in the KITTI paper, worked out here with the plain matrices."""
    scan = open_drive(kitti_raw_log(cameras=("02", "03"))).scenes[0].scans[0]
    for number, camera in zip((2, 3), scan.cameras, strict=True):
        velo = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]])
        p = np.array([[40, 0, 32, -number * 20.0], [0, 40, 24, 0], [0, 0, 1, 0]])
        u, v, w = p @ np.append(velo @ np.append(POINT[0], 1), 1)
        assert pixel(scan, camera) == pytest.approx((u / w, v / w))
        assert is_rigid(camera.camera_to_ego)


def test_colour_is_preferred_and_grey_taken_where_there_is_no_colour(kitti_raw_log, semantickitti_log):
    assert [c.channel for c in open_drive(kitti_raw_log(cameras=("00", "03"))).scenes[0].scans[0].cameras] == [
        "image_03"
    ]
    grey = open_drive(semantickitti_log(cameras=(0, 1))).scenes[0].scans[0].cameras
    assert [c.channel for c in grey] == ["image_0", "image_1"]


def test_raw_lost_scans_keep_their_own_time_and_image(kitti_raw_log):
    """Frame numbers have gaps where the recording lost a scan; line n of timestamps.txt is still frame n."""
    root = kitti_raw_log(scans=4)
    next(root.rglob("velodyne_points/data/0000000001.bin")).unlink()
    scans = open_drive(root).scenes[0].scans
    assert [s.number for s in scans] == ["0000000000", "0000000002", "0000000003"]
    assert [s.index for s in scans] == [0, 1, 2]
    assert [s.cameras[0].path.stem for s in scans] == [s.number for s in scans]
    assert scans[1].timestamp - scans[0].timestamp == 200_000


def test_raw_scan_without_its_image(kitti_raw_log):
    root = kitti_raw_log()
    next(root.rglob("image_02/data/0000000001.png")).unlink()
    assert [len(s.cameras) for s in open_drive(root).scenes[0].scans] == [1, 0, 1]


@pytest.mark.parametrize("content", [None, "2011-09-26 13:02:25.0\n", "yesterday\n" * 3])
def test_raw_without_sound_time_stamps_takes_10_hz_and_says_so(kitti_raw_log, content):
    root = kitti_raw_log()
    path = next(root.rglob("velodyne_points/timestamps.txt"))
    path.unlink() if content is None else path.write_text(content)
    drive = open_drive(root)
    assert np.diff([s.timestamp for s in drive.scenes[0].scans]).tolist() == [100_000, 100_000]
    assert [(p.code, p.severity) for p in drive.problems] == [("bad-timestamps", "warning")]


@pytest.mark.parametrize("name", ["calib_velo_to_cam.txt", "calib_cam_to_cam.txt"])
def test_raw_without_calibration(kitti_raw_log, name):
    root = kitti_raw_log()
    next(root.rglob(name)).unlink()
    with pytest.raises(DriveLogError) as caught:
        open_drive(root)
    assert [(p.code, p.where) for p in caught.value.problems] == [("missing-calibration", f"2011_09_26/{name}")]


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("calib_velo_to_cam.txt", "R: 0", "R: nan"),
        ("calib_velo_to_cam.txt", "R: 0", "R: 9"),
        ("calib_velo_to_cam.txt", "T: 0.1", "T:"),
        ("calib_cam_to_cam.txt", "R_rect_00: 1", "R_rect_00: -1"),
        ("calib_cam_to_cam.txt", "R_rect_00", "R_rect_xx"),
        ("calib_cam_to_cam.txt", ": 40.0 0 32", ": 0 0 32"),
        ("calib_cam_to_cam.txt", "P_rect", "Q_rect"),
    ],
)
def test_raw_with_nonsense_in_the_calibration(kitti_raw_log, name, old, new):
    root = kitti_raw_log()
    path = next(root.rglob(name))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DriveLogError) as caught:
        open_drive(root)
    assert {(p.code, p.where) for p in caught.value.problems} == {("bad-calibration", f"2011_09_26/{name}")}


def test_sequences_are_scenes(semantickitti_log):
    drive = open_drive(semantickitti_log(sequences=("00", "08")))
    assert (drive.format, drive.truth_space, drive.sensor_height) == ("semantickitti", "semantickitti", 1.73)
    assert [s.name for s in drive.scenes] == ["00", "08"]
    assert drive.scenes[1].scans[2].token == "08_000002"
    assert drive.scenes[1].scans[2].number == "000002"
    assert [s.timestamp for s in drive.scenes[0].scans] == [0, 100_000, 200_000]
    assert drive.problems == ()


def test_sequence_projection(semantickitti_log):
    scan = open_drive(semantickitti_log(cameras=(2,))).scenes[0].scans[0]
    tr = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]])
    u, v, w = np.array([[40, 0, 32, -40.0], [0, 40, 24, 0], [0, 0, 1, 0]]) @ np.append(tr @ np.append(POINT[0], 1), 1)
    assert pixel(scan, scan.cameras[0]) == pytest.approx((u / w, v / w))


def test_camera_poses_become_lidar_poses(semantickitti_log):
    """Camera 0 drives along its z axis; the LiDAR's x axis points the same way."""
    scans = open_drive(semantickitti_log()).scenes[0].scans
    np.testing.assert_allclose(scans[0].ego_to_world, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(apply(scans[2].ego_to_world, np.zeros((1, 3))), [[4.0, 0, 0]], atol=1e-12)


def test_labels_in_the_19_classes(semantickitti_log):
    truth = open_drive(semantickitti_log()).scenes[0].scans[0].load_truth()
    assert truth.semantic[[0, 20, 30]].tolist() == [1, 1, 9]
    assert truth.instance[[0, 20, 30]].tolist() == [7, 8, 0]
    assert truth.has_instances


def test_stuff_has_no_instance(semantickitti_log):
    root = semantickitti_log()
    path = next(root.rglob("000000.label"))
    np.full(300, 40 | 5 << 16, "<u4").tofile(path)
    assert not open_drive(root).scenes[0].scans[0].load_truth().instance.any()


def test_whether_a_log_has_instances_is_told_by_all_its_labels(semantickitti_log):
    root = semantickitti_log()
    paths = sorted(root.rglob("*.label"))
    for path in paths[:2]:
        np.full(300, 10, "<u4").tofile(path)
    assert open_drive(root).scenes[0].scans[0].load_truth().has_instances
    np.full(300, 10, "<u4").tofile(paths[2])
    assert not open_drive(root).scenes[0].scans[0].load_truth().has_instances


@pytest.mark.parametrize(("size", "says"), [(1196, "299 labels and the scan 300 points"), (1198, "not whole labels")])
def test_labels_that_do_not_fit(semantickitti_log, size, says):
    root = semantickitti_log()
    path = next(root.rglob("000000.label"))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DriveLogError, match=says):
        open_drive(root).scenes[0].scans[0].load_truth()


def test_plain_odometry_has_no_truth(semantickitti_log):
    drive = open_drive(semantickitti_log(labels=False))
    assert not drive.has_truth
    assert drive.scenes[0].scans[0].load_truth is None


def test_images_of_some_scans_only(semantickitti_log):
    root = semantickitti_log(scans=4)
    for n in (2, 3):
        next(root.rglob(f"image_2/{n:06d}.png")).unlink()
    assert [len(s.cameras) for s in open_drive(root).scenes[0].scans] == [1, 1, 0, 0]


def test_log_without_images_is_still_a_log(semantickitti_log):
    drive = open_drive(semantickitti_log(cameras=()))
    assert drive.has_truth
    assert all(not s.cameras for s in drive.scenes[0].scans)


@pytest.mark.parametrize("change", ["missing", "no Tr", "nan", "binary"])
def test_sequence_without_usable_calibration_is_left_out_and_named(semantickitti_log, change):
    root = semantickitti_log(sequences=("00", "01"))
    path = root / "sequences/01/calib.txt"
    text = path.read_text()
    if change == "missing":
        path.unlink()
    elif change == "no Tr":
        path.write_text(text.split("Tr:")[0])
    elif change == "nan":
        path.write_text(text.replace("Tr: 0", "Tr: nan"))
    else:
        path.write_bytes(b"\xff\xfe\x00")
    drive = open_drive(root)
    assert [s.name for s in drive.scenes] == ["00"]
    (problem,) = drive.problems
    assert (problem.where, problem.severity, problem.scene) == ("sequences/01/calib.txt", "error", "01")
    assert problem.code in {"missing-calibration", "bad-calibration"}


def test_camera_with_images_but_no_projection(semantickitti_log):
    root = semantickitti_log(cameras=(2, 3))
    path = root / "sequences/00/calib.txt"
    path.write_text(path.read_text().replace("P3:", "Q3:"))
    drive = open_drive(root)
    assert [c.channel for c in drive.scenes[0].scans[0].cameras] == ["image_2"]
    assert [(p.code, p.scene) for p in drive.problems] == [("missing-calibration", "00")]


@pytest.mark.parametrize("content", ["1 0 0 0 0 1 0 0 0 0 1 0\n", "1 2 3\n" * 3, "nan " * 12 + "\n"])
def test_unsound_poses_are_not_used(semantickitti_log, content):
    root = semantickitti_log()
    (root / "sequences/00/poses.txt").write_text(content)
    drive = open_drive(root)
    assert all(s.ego_to_world is None for s in drive.scenes[0].scans)
    assert [(p.code, p.severity) for p in drive.problems] == [("bad-pose", "warning")]


@pytest.mark.parametrize("content", ["0.0\n", "a\nb\nc\n", f"{math.inf}\n" * 3])
def test_unsound_times(semantickitti_log, content):
    root = semantickitti_log()
    (root / "sequences/00/times.txt").write_text(content)
    drive = open_drive(root)
    assert [s.timestamp for s in drive.scenes[0].scans] == [0, 100_000, 200_000]
    assert [(p.code, p.severity) for p in drive.problems] == [("bad-timestamps", "warning")]


def test_files_that_are_no_scans_are_left_alone(semantickitti_log):
    """Copies made on other systems bring their own files."""
    root = semantickitti_log()
    for name in ("._000000.bin", ".DS_Store", "readme.bin", "000001.bin.tmp", "Thumbs.db"):
        (root / "sequences/00/velodyne" / name).write_bytes(b"x")
    assert [s.number for s in open_drive(root).scenes[0].scans] == ["000000", "000001", "000002"]
