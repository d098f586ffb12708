"""nuScenes logs: what is read, and what broken tables lead to."""

import json
import math
import pickle

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.errors import DriveLogError
from l3ps.geometry import apply


def codes(problems):
    return {p.code for p in problems}


def test_keyframes_with_their_cameras(nuscenes_log):
    log = nuscenes_log(scenes=2, scans=3, cameras=("CAM_FRONT", "CAM_BACK"))
    drive = open_drive(log.root)
    assert (drive.format, drive.truth_space, drive.problems) == ("nuscenes", "nuscenes", ())
    assert [(s.name, len(s.scans)) for s in drive.scenes] == [("scene-0000", 3), ("scene-0001", 3)]
    scan = drive.scenes[1].scans[2]
    assert (scan.token, scan.index, scan.is_keyframe) == ("LIDAR_TOP-1-2-0", 2, True)
    assert [c.channel for c in scan.cameras] == ["CAM_FRONT", "CAM_BACK"]
    assert scan.cameras[0].size == (64, 48)
    assert scan.cameras[0].timestamp - scan.timestamp == 20_000
    assert drive.sensor_height == pytest.approx(1.8)
    assert not drive.has_truth


def test_points_in_file_order(nuscenes_log):
    log = nuscenes_log()
    raw = np.fromfile(log.root / log.scans()[0]["filename"], np.float32).reshape(-1, 5)
    points = open_drive(log.root).scenes[0].scans[0].load_points()
    np.testing.assert_array_equal(points.xyz, raw[:, :3])
    np.testing.assert_allclose(points.intensity, raw[:, 3] / 255, rtol=1e-6)
    np.testing.assert_array_equal(points.ring, raw[:, 4])


def test_a_column_of_zeros_is_no_ring(nuscenes_log):
    log = nuscenes_log(scans=1)
    path = log.root / log.scans()[0]["filename"]
    rows = np.fromfile(path, np.float32).reshape(-1, 5)
    rows[:, 4] = 0
    rows.tofile(path)
    assert open_drive(log.root).scenes[0].scans[0].load_points().ring is None


def test_motion_between_scan_and_exposure_is_taken_into_account(nuscenes_log):
    """The car drives 0.2 m in the 20 ms until the camera fires, so the camera has come nearer by that."""
    log = nuscenes_log()
    scan = open_drive(log.root).scenes[0].scans[0]
    in_camera = apply(scan.lidar_to_camera(scan.cameras[0]), np.array([[10.0, 1.0, 0.2]]))
    np.testing.assert_allclose(in_camera, [[-1.0, -(0.2 + 1.8 - 1.5), 10.0 - 0.2]], atol=1e-9)


def test_sweeps_on_request_lie_between_the_keyframes_and_have_no_cameras(nuscenes_log):
    log = nuscenes_log(scans=2, sweeps=2)
    assert len(open_drive(log.root).scenes[0].scans) == 2
    scans = open_drive(log.root, sweeps=True).scenes[0].scans
    assert [s.is_keyframe for s in scans] == [True, False, False, True, False, False]
    assert [len(s.cameras) for s in scans] == [1, 0, 0, 1, 0, 0]
    assert [s.index for s in scans] == list(range(6))
    assert [s.timestamp for s in scans] == sorted(s.timestamp for s in scans)


def test_scans_follow_the_links_not_the_table(nuscenes_log):
    log = nuscenes_log()
    log.tables["sample"].reverse()
    log.tables["sample_data"].reverse()
    log.save()
    assert [s.token for s in open_drive(log.root).scenes[0].scans] == [f"LIDAR_TOP-0-{i}-0" for i in range(3)]


def test_sweeps_follow_their_links_too(nuscenes_log):
    """In nuScenes a sweep belongs to the keyframe it is closest to, so it may come before it."""
    log = nuscenes_log(scans=2, sweeps=2)
    for row in log.tables["sample_data"]:
        if row["token"] == "LIDAR_TOP-0-0-2":
            row["sample_token"] = "k0-1"
    log.tables["sample_data"].reverse()
    scans = open_drive(log.save(), sweeps=True).scenes[0].scans
    assert [s.token[-3:] for s in scans] == ["0-0", "0-1", "0-2", "1-0", "1-1", "1-2"]


def test_a_broken_link_loses_no_scan(nuscenes_log):
    log = nuscenes_log(scans=4)
    log.tables["sample"][1]["next"] = "nowhere"
    drive = open_drive(log.save())
    assert [s.token for s in drive.scenes[0].scans] == [f"LIDAR_TOP-0-{i}-0" for i in range(4)]
    assert [p.code for p in drive.problems] == ["broken-links"]


def test_without_links_time_decides_and_a_warning_says_so(nuscenes_log):
    log = nuscenes_log()
    log.tables["sample"].reverse()
    for row in log.tables["sample"]:
        row["next"] = "nowhere"
        del row["prev"]
    log.save()
    drive = open_drive(log.root)
    assert [s.token for s in drive.scenes[0].scans] == [f"LIDAR_TOP-0-{i}-0" for i in range(3)]
    assert [(p.code, p.severity) for p in drive.problems] == [("broken-links", "warning")]


def test_panoptic_truth_in_challenge_classes(nuscenes_log):
    log = nuscenes_log(scans=1)
    raw = np.zeros(300, int)
    raw[0:10] = 2001  # adult 1
    raw[10:20] = 3001  # child 1: also class 7, another person
    raw[20:30] = 17005  # car
    raw[30:40] = 24000  # driveable surface
    raw[40:50] = 1001  # animal: void
    raw[50:60] = 17000  # car without instance
    log.truth("panoptic", {"LIDAR_TOP-0-0-0": raw})
    truth = open_drive(log.save()).scenes[0].scans[0].load_truth()
    assert truth.semantic[[0, 10, 20, 30, 40, 50, 60]].tolist() == [7, 7, 4, 11, 0, 4, 0]
    assert truth.has_instances
    assert truth.instance[0] != truth.instance[10]
    assert len(np.unique(truth.instance[:30])) == 3
    assert truth.instance[0] > 0
    assert not truth.instance[30:].any()


def test_panoptic_wins_over_lidarseg(nuscenes_log):
    log = nuscenes_log(scans=2)
    tokens = [row["token"] for row in log.scans()]
    log.truth("lidarseg", {token: np.full(300, 24) for token in tokens})
    log.truth("panoptic", {tokens[0]: np.full(300, 17001)})
    first, second = open_drive(log.save()).scenes[0].scans
    assert first.load_truth().semantic[0] == 4
    assert second.load_truth().semantic[0] == 11
    assert not second.load_truth().has_instances


def test_category_table_decides_what_an_index_means(nuscenes_log):
    log = nuscenes_log(scans=1)
    log.tables["category"] = [{"token": "a", "name": "vehicle.car", "index": 3}, {"token": "b", "name": "noise"}]
    log.truth("lidarseg", {"LIDAR_TOP-0-0-0": np.full(300, 3)})
    assert set(open_drive(log.save()).scenes[0].scans[0].load_truth().semantic) == {4}


def test_truth_of_another_length_is_refused(nuscenes_log):
    log = nuscenes_log(scans=1)
    log.truth("panoptic", {"LIDAR_TOP-0-0-0": np.full(299, 17001)})
    scan = open_drive(log.save()).scenes[0].scans[0]
    with pytest.raises(DriveLogError, match="299 labels and the scan 300 points"):
        scan.load_truth()


def test_truth_that_is_no_array(nuscenes_log):
    log = nuscenes_log(scans=1)
    log.truth("panoptic", {"LIDAR_TOP-0-0-0": np.full(300, 17001)})
    scan = open_drive(log.save()).scenes[0].scans[0]
    scan.truth_path.write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(DriveLogError, match="the truth cannot be read"):
        scan.load_truth()


def test_pickled_truth_is_not_unpickled(nuscenes_log, tmp_path):
    """np.load on an object array would run code that the log's author chose."""
    log = nuscenes_log(scans=1)
    log.truth("panoptic", {"LIDAR_TOP-0-0-0": np.full(300, 17001)})
    scan = open_drive(log.save()).scenes[0].scans[0]
    np.savez(scan.truth_path, data=np.array([{}] * 300, dtype=object))
    with pytest.raises(DriveLogError, match="truth cannot be read"):
        scan.load_truth()


@pytest.mark.parametrize("height", [0.0, 12.0])
def test_a_lidar_in_the_ego_origin_tells_no_height(nuscenes_log, height):
    log = nuscenes_log()
    log.rows("calibrated_sensor", token="c-LIDAR_TOP")[0]["translation"][2] = height
    assert open_drive(log.save()).sensor_height is None


def test_scans_travel_to_another_process(nuscenes_log):
    log = nuscenes_log()
    log.truth("panoptic", {"LIDAR_TOP-0-0-0": np.full(300, 17001)})
    drive = pickle.loads(pickle.dumps(open_drive(log.save())))
    assert len(drive.scenes[0].scans[0].load_points()) == len(drive.scenes[0].scans[0].load_truth().semantic)


@pytest.mark.parametrize("table", ["scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose"])
def test_missing_table(nuscenes_log, table):
    log = nuscenes_log()
    (log.folder / f"{table}.json").unlink()
    with pytest.raises(DriveLogError) as caught:
        open_drive(log.root)
    assert ("missing-table", f"v1.0-mini/{table}.json") in {(p.code, p.where) for p in caught.value.problems}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "empty"),
        ("{}", "does not hold a JSON list"),
        ("[1, 2]", "2 of 2 rows are not JSON objects"),
        ('[{"token": "x"}]', "have no 'name'"),
        ('[{"token": "x", "name": 7}]', "'name' that is not a plain name"),
        ('[{"token": "x", "name": "../../etc"}]', "'name' that is not a plain name"),
        ('[{"token": "x", "name": "a"}', "truncated"),
        ('[{"token": "x", "na', "truncated or not valid JSON"),
        ('[{"token": "x", "name": "a"} {"token": "y", "name": "b"}]', "comma"),
        ("[" * 100_000, "nested too deeply"),
        ("[" + "9" * 10_000 + "]", "far too long"),
        (b"\xff\xfe[]", "not UTF-8"),
    ],
)
def test_damaged_table(nuscenes_log, content, says):
    log = nuscenes_log()
    (log.folder / "scene.json").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DriveLogError) as caught:
        open_drive(log.root)
    assert [p.where for p in caught.value.problems] == ["v1.0-mini/scene.json"]
    assert says in caught.value.problems[0].what


def test_all_damaged_tables_are_named_at_once(nuscenes_log):
    log = nuscenes_log()
    (log.folder / "scene.json").write_text("nonsense")
    (log.folder / "ego_pose.json").unlink()
    log.tables["sensor"][0].pop("channel")
    (log.folder / "sensor.json").write_text(json.dumps(log.tables["sensor"]))
    with pytest.raises(DriveLogError) as caught:
        open_drive(log.root)
    assert {p.where.split("/")[1] for p in caught.value.problems} >= {"scene.json", "ego_pose.json", "sensor.json"}


def test_log_without_lidar(nuscenes_log):
    log = nuscenes_log()
    log.rows("sensor", channel="LIDAR_TOP")[0]["modality"] = "radar"
    with pytest.raises(DriveLogError, match="no sensor of modality 'lidar'"):
        open_drive(log.save())


def test_log_without_calibration(nuscenes_log):
    log = nuscenes_log()
    log.tables["calibrated_sensor"] = []
    with pytest.raises(DriveLogError) as caught:
        open_drive(log.save())
    assert "missing-calibration" in codes(caught.value.problems)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("rotation", [0, 0, 0, 0]),
        ("rotation", [math.nan, 0, 0, 1]),
        ("rotation", [1, 0, 0]),
        ("rotation", ["1", 0, 0, 0]),
        ("translation", [math.inf, 0, 0]),
        ("translation", [0, 0]),
        ("translation", [[0], 0, 0]),
        ("translation", [10**400, 0, 0]),
    ],
)
def test_nonsense_in_one_camera_calibration_costs_that_camera(nuscenes_log, column, value):
    log = nuscenes_log(cameras=("CAM_FRONT", "CAM_BACK"))
    log.rows("calibrated_sensor", token="c-CAM_FRONT")[0][column] = value
    drive = open_drive(log.save())
    assert [c.channel for c in drive.scenes[0].scans[0].cameras] == ["CAM_BACK"]
    (problem,) = drive.problems
    assert (problem.code, problem.severity, problem.scene) == ("bad-calibration", "error", "scene-0000")
    assert "c-CAM_FRONT" in problem.what


@pytest.mark.parametrize(
    "intrinsic",
    [[], None, [[1, 2], [3, 4]], [[0, 0, 1], [0, 1, 1], [0, 0, 1]], [[1, 0, 1], [0, math.nan, 1], [0, 0, 1]]],
)
def test_camera_without_a_usable_intrinsic(nuscenes_log, intrinsic):
    log = nuscenes_log()
    log.rows("calibrated_sensor", token="c-CAM_FRONT")[0]["camera_intrinsic"] = intrinsic
    drive = open_drive(log.save())
    assert codes(drive.problems) == {"bad-calibration"}
    assert drive.scenes[0].scans[0].cameras == ()


def test_unknown_pose_costs_one_scan(nuscenes_log):
    log = nuscenes_log()
    log.scans()[1]["ego_pose_token"] = "nowhere"
    drive = open_drive(log.save())
    assert [s.token for s in drive.scenes[0].scans] == ["LIDAR_TOP-0-0-0", "LIDAR_TOP-0-2-0"]
    (problem,) = drive.problems
    assert (problem.code, problem.severity, problem.scan) == ("bad-pose", "scan", "LIDAR_TOP-0-1-0")


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "samples/../../x", "a\\..\\b", "a\0b", ""])
@pytest.mark.parametrize("channel", ["LIDAR_TOP", "CAM_FRONT"])
def test_file_names_stay_inside_the_log(nuscenes_log, name, channel):
    log = nuscenes_log(scans=2)
    log.rows("sample_data", token=f"{channel}-0-1-0")[0]["filename"] = name
    drive = open_drive(log.save())
    (problem,) = drive.problems
    assert (problem.code, problem.severity) == ("unsafe-path", "error")
    paths = [p for s in drive.scenes[0].scans for p in (s.path, *(c.path for c in s.cameras))]
    assert all(path.is_relative_to(log.root) and ".." not in path.parts for path in paths)


def test_truth_names_stay_inside_the_log(nuscenes_log):
    log = nuscenes_log(scans=1)
    log.truth("lidarseg", {"LIDAR_TOP-0-0-0": np.full(300, 24)})
    log.tables["lidarseg"][0]["filename"] = "../../secret.bin"
    drive = open_drive(log.save())
    assert codes(drive.problems) == {"unsafe-path"}
    assert drive.scenes[0].scans[0].load_truth is None


def test_tokens_that_cannot_name_a_label_file_are_refused(nuscenes_log):
    log = nuscenes_log()
    log.scans()[0]["token"] = "../../label"
    with pytest.raises(DriveLogError, match="'token' that is not a plain name"):
        open_drive(log.save())


def test_doubled_token(nuscenes_log):
    log = nuscenes_log()
    log.scans()[1]["token"] = log.scans()[0]["token"]
    with pytest.raises(DriveLogError, match="occur in more than one row"):
        open_drive(log.save())


def test_two_scenes_of_one_name(nuscenes_log):
    """Their label files would overwrite each other."""
    log = nuscenes_log(scenes=2)
    log.tables["scene"][1]["name"] = "scene-0000"
    with pytest.raises(DriveLogError, match="2 scenes have the name scene-0000"):
        open_drive(log.save())


def test_sample_without_scan(nuscenes_log):
    log = nuscenes_log()
    log.tables["sample_data"] = [r for r in log.tables["sample_data"] if r["token"] != "LIDAR_TOP-0-1-0"]
    drive = open_drive(log.save())
    assert len(drive.scenes[0].scans) == 2
    assert [(p.code, p.severity) for p in drive.problems] == [("missing-scan", "scan")]
    assert "k0-1" in drive.problems[0].what


def test_scene_without_scans_is_left_out_and_named(nuscenes_log):
    log = nuscenes_log(scenes=2)
    log.tables["sample_data"] = [r for r in log.tables["sample_data"] if not r["token"].startswith("LIDAR_TOP-1")]
    drive = open_drive(log.save())
    assert [s.name for s in drive.scenes] == ["scene-0000"]
    assert ("no-scans", "scene-0001") in {(p.code, p.scene) for p in drive.problems}


def test_second_lidar_is_left_alone_with_a_warning(nuscenes_log):
    log = nuscenes_log()
    log.tables["sensor"].append({"token": "s-2", "channel": "LIDAR_SIDE", "modality": "lidar"})
    drive = open_drive(log.save())
    assert [(p.code, p.severity) for p in drive.problems] == [("several-lidars", "warning")]


def test_scan_is_judged_when_it_is_read(nuscenes_log):
    log = nuscenes_log(scans=3)
    drive = open_drive(log.root)
    paths = [scan.path for scan in drive.scenes[0].scans]
    paths[0].unlink()
    # 4 columns would fit this size, and are refused all the same
    paths[1].write_bytes(paths[1].read_bytes()[: 299 * 20 + 4])
    rows = np.fromfile(paths[2], np.float32).reshape(-1, 5)
    rows[7, 1] = np.nan
    rows.tofile(paths[2])
    for scan, code in zip(drive.scenes[0].scans, ["missing-file", "truncated-scan", "non-finite-points"], strict=True):
        with pytest.raises(DriveLogError) as caught:
            scan.load_points()
        assert codes(caught.value.problems) == {code}
        assert caught.value.problems[0].where == scan.path.relative_to(log.root).as_posix()
