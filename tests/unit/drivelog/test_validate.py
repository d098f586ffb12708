"""Pre-flight validation: every problem, each with its file, and the good scans that remain."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from l3ps.drivelog import open_drive, validate, without_bad_scans
from l3ps.drivelog.validate import longest_increasing
from l3ps.errors import Cancelled, DriveLogError

CAMERAS = ("CAM_FRONT", "CAM_BACK")


def brief(problems):
    return {(p.code, p.where, p.severity, p.scan) for p in problems}


def rewrite(path, change, columns=5):
    rows = np.fromfile(path, np.float32).reshape(-1, columns)
    change(rows)
    rows.tofile(path)


def test_sound_logs_have_no_problems(nuscenes_log, kitti_raw_log, semantickitti_log):
    log = nuscenes_log(scenes=2, cameras=CAMERAS, sweeps=1)
    log.truth("panoptic", {row["token"]: np.full(300, 17001) for row in log.scans()})
    for root in (log.save(), kitti_raw_log(drives=2), semantickitti_log(("00", "01"))):
        assert validate(open_drive(root)) == []
    assert validate(open_drive(log.root, sweeps=True)) == []


SPOILED = {
    "missing scan": ("missing-file", "LIDAR", lambda p: p.unlink()),
    "scan of 3 bytes": ("truncated-scan", "LIDAR", lambda p: p.write_bytes(b"abc")),
    "empty scan": ("truncated-scan", "LIDAR", lambda p: p.write_bytes(b"")),
    "scan cut short": ("truncated-scan", "LIDAR", lambda p: p.write_bytes(p.read_bytes()[:-7])),
    "scan of nine points": ("truncated-scan", "LIDAR", lambda p: p.write_bytes(p.read_bytes()[:180])),
    "nan": ("non-finite-points", "LIDAR", lambda p: rewrite(p, lambda r: r.__setitem__((0, 2), np.nan))),
    "infinite": ("non-finite-points", "LIDAR", lambda p: rewrite(p, lambda r: r.__setitem__((9, 0), -np.inf))),
    "big-endian": ("implausible-points", "LIDAR", lambda p: rewrite(p, lambda r: r.__setitem__((9, 0), 1e7))),
    "missing image": ("missing-file", "CAM_FRONT", lambda p: p.unlink()),
    "image cut short": ("bad-image", "CAM_FRONT", lambda p: p.write_bytes(p.read_bytes()[:-9])),
    "image is a web page": ("bad-image", "CAM_FRONT", lambda p: p.write_bytes(b"<html>")),
    "folder for an image": ("missing-file", "CAM_FRONT", lambda p: (p.unlink(), p.mkdir())),
}


@pytest.mark.parametrize("name", SPOILED)
def test_what_spoils_one_scan(nuscenes_log, name):
    code, sensor, spoil = SPOILED[name]
    log = nuscenes_log(cameras=CAMERAS)
    row = next(r for r in log.tables["sample_data"] if sensor in r["filename"] and "-0-1-0" in r["token"])
    spoil(log.root / row["filename"])
    problems = validate(open_drive(log.root))
    assert brief(problems) == {(code, row["filename"], "scan", "LIDAR_TOP-0-1-0")}
    assert all(p.scene == "scene-0000" and p.remedy for p in problems)
    good = open_drive(log.root, skip_bad_scans=True)
    assert [(s.token, s.index) for s in good.scenes[0].scans] == [("LIDAR_TOP-0-0-0", 0), ("LIDAR_TOP-0-2-0", 1)]
    assert validate(good) == []


def test_messages_carry_the_numbers(nuscenes_log):
    log = nuscenes_log()
    (log.root / log.scans()[0]["filename"]).write_bytes(b"abc")
    rewrite(log.root / log.scans()[1]["filename"], lambda r: r.__setitem__((slice(0, 30), 0), np.nan))
    first, second = validate(open_drive(log.root))
    assert "3 bytes" in first.what
    assert "20 bytes" in first.what
    assert "30 of 300 points (10.0 %)" in second.what


def test_wrong_image_size(nuscenes_log, semantickitti_log, make_png):
    """Against the declared size, or against the camera's other images where none is declared."""
    log = nuscenes_log()
    name = "samples/CAM_FRONT/CAM_FRONT-0-2-0.png"
    log.write(name, make_png(32, 24))
    (problem,) = validate(open_drive(log.root))
    assert (problem.code, problem.where, problem.scan) == ("wrong-image-size", name, "LIDAR_TOP-0-2-0")
    assert "32x24" in problem.what
    assert "64x48" in problem.what
    root = semantickitti_log()
    (root / "sequences/00/image_2/000001.png").write_bytes(make_png(60, 48))
    assert brief(validate(open_drive(root))) == {
        ("wrong-image-size", "sequences/00/image_2/000001.png", "scan", "00_000001")
    }


def test_truth_that_does_not_fit(nuscenes_log, semantickitti_log):
    log = nuscenes_log()
    tokens = [row["token"] for row in log.scans()]
    log.truth("panoptic", dict(zip(tokens, [np.zeros(300), np.zeros(299), np.zeros((300, 1))], strict=True)))
    log.save()
    found = validate(open_drive(log.root))
    assert [(p.code, p.scan) for p in found] == [("truth-length", tokens[1]), ("bad-truth", tokens[2])]
    (log.root / log.tables["panoptic"][0]["filename"]).unlink()
    assert validate(open_drive(log.root))[0].code == "missing-file"
    root = semantickitti_log()
    path = root / "sequences/00/labels/000000.label"
    path.write_bytes(path.read_bytes()[:-4])
    assert [(p.code, p.scan) for p in validate(open_drive(root))] == [("truth-length", "00_000000")]


def test_one_wrong_time_stamp_accuses_only_itself(nuscenes_log):
    """A stamp far in the future makes every later one look wrong; it is the odd one all the same."""
    log = nuscenes_log(scans=5)
    log.scans()[1]["timestamp"] += 10**12
    log.save()
    (problem,) = validate(open_drive(log.root))
    assert (problem.code, problem.severity, problem.scan) == ("time-order", "scan", "LIDAR_TOP-0-1-0")


def test_equal_time_stamps(semantickitti_log):
    root = semantickitti_log()
    (root / "sequences/00/times.txt").write_text("0.0\n0.1\n0.1\n")
    assert [p.code for p in validate(open_drive(root))] == ["time-order"]


@pytest.mark.parametrize(
    ("values", "length"),
    [
        ([], 0),
        ([5], 1),
        ([1, 2, 3], 3),
        ([3, 2, 1], 1),
        ([1, 99, 2, 3], 3),
        ([1, 1, 1], 1),
        ([2, 5, 3, 7, 11, 8, 10], 5),
    ],
)
def test_longest_increasing(values, length):
    chosen = [values[i] for i in longest_increasing(values)]
    assert len(chosen) == length
    assert all(a < b for a, b in pairwise(chosen))


def test_calibration_under_which_no_point_falls_into_an_image(nuscenes_log):
    """The camera looks at the sky."""
    log = nuscenes_log(cameras=CAMERAS)
    log.rows("calibrated_sensor", token="c-CAM_BACK")[0]["rotation"] = [1, 0, 0, 0]
    log.save()
    (problem,) = validate(open_drive(log.root))
    assert (problem.code, problem.severity, problem.scene) == ("no-point-in-image", "error", "scene-0000")
    assert "CAM_BACK" in problem.where


def test_pose_that_throws_one_scan_off_the_images(nuscenes_log):
    log = nuscenes_log()
    log.rows("ego_pose", token="p-LIDAR_TOP-0-1-0")[0]["translation"] = [0, 5000, 0]
    log.save()
    assert brief(validate(open_drive(log.root))) == {
        ("no-point-in-image", "samples/LIDAR_TOP/LIDAR_TOP-0-1-0.pcd.bin", "scan", "LIDAR_TOP-0-1-0")
    }


def test_scans_without_images(semantickitti_log):
    root = semantickitti_log()
    (root / "sequences/00/image_2/000001.png").unlink()
    (problem,) = validate(open_drive(root))
    assert (problem.code, problem.severity) == ("no-images", "warning")
    assert "1 of 3 scans" in problem.what
    for path in root.rglob("*.png"):
        path.unlink()
    (problem,) = validate(open_drive(root))
    assert (problem.code, problem.severity, problem.scene) == ("no-images", "error", "00")


def test_everything_is_found_at_once(nuscenes_log, make_png):
    log = nuscenes_log(scenes=3, scans=4, cameras=CAMERAS)
    log.truth("lidarseg", {"LIDAR_TOP-2-2-0": np.zeros(7)})
    scans = {row["token"]: log.root / row["filename"] for row in log.scans()}
    scans["LIDAR_TOP-0-0-0"].unlink()
    scans["LIDAR_TOP-0-1-0"].write_bytes(b"abc")
    rewrite(scans["LIDAR_TOP-0-2-0"], lambda r: r.fill(np.nan))
    log.write("samples/CAM_FRONT/CAM_FRONT-0-3-0.png", b"")
    log.write("samples/CAM_BACK/CAM_BACK-0-3-0.png", make_png(8, 8))
    log.rows("sample_data", token="LIDAR_TOP-2-0-0")[0]["ego_pose_token"] = "nowhere"
    log.rows("sample_data", token="LIDAR_TOP-2-1-0")[0]["timestamp"] = 10**17
    log.rows("sample_data", token="CAM_BACK-1-0-0")[0]["filename"] = "../../x.png"
    log.save()
    drive = open_drive(log.root)
    problems = validate(drive)
    assert {p.code for p in problems} == {
        "missing-file",
        "truncated-scan",
        "non-finite-points",
        "bad-image",
        "wrong-image-size",
        "bad-pose",
        "time-order",
        "unsafe-path",
        "truth-length",
    }
    good = without_bad_scans(drive, problems)
    assert [(s.name, [x.token for x in s.scans]) for s in good.scenes] == [("scene-0002", ["LIDAR_TOP-2-3-0"])]


def test_two_scans_of_one_token(nuscenes_log):
    """Their label files would overwrite each other."""
    drive = open_drive(nuscenes_log(scenes=2).root)
    first, second = drive.scenes
    doubled = replace(second, scans=(replace(second.scans[0], token=first.scans[0].token), *second.scans[1:]))
    problems = validate(replace(drive, scenes=(first, doubled)))
    assert [(p.code, p.severity, p.scene) for p in problems] == [("duplicate-token", "error", "scene-0001")]


def test_nothing_left(nuscenes_log):
    log = nuscenes_log(scans=2)
    for row in log.scans():
        (log.root / row["filename"]).unlink()
    with pytest.raises(DriveLogError) as caught:
        open_drive(log.root, skip_bad_scans=True)
    assert [p.code for p in caught.value.problems] == ["missing-file", "missing-file"]


def test_a_problem_of_the_whole_log_cannot_be_skipped(kitti_raw_log):
    root = kitti_raw_log(cameras=("02", "03"))
    path = next(root.rglob("calib_cam_to_cam.txt"))
    path.write_text(path.read_text().replace("P_rect_03: 40.0", "P_rect_03: nan"))
    with pytest.raises(DriveLogError, match="P_rect_03"):
        open_drive(root, skip_bad_scans=True)


def test_progress_and_stopping(nuscenes_log):
    drive = open_drive(nuscenes_log(scenes=2).root)
    seen = []
    validate(drive, lambda stage, done, total: seen.append((stage, done, total)))
    assert seen == [("validate", i, 6) for i in range(1, 7)]

    def stop(stage: str, done: int, total: int) -> None:
        raise Cancelled(stage)

    with pytest.raises(Cancelled):
        validate(drive, stop)
