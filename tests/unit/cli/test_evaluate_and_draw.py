"""``l3ps evaluate`` and ``l3ps draw`` on a log small enough to write by hand."""

import json
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from l3ps.draw import VOID, distinct_colors
from l3ps.drivelog import open_drive
from l3ps.labels import ScanLabels, write_poses, write_scene
from l3ps.taxonomy import NUSCENES16, SEMANTICKITTI19
from l3ps_cli.main import app

CAR, ROAD = 4, 11
CAR_COLOR, ROAD_COLOR = (NUSCENES16.colors[c] for c in (CAR, ROAD))


@pytest.fixture
def log(tmp_path):
    """Two scans, the first with truth: a car of 100 points at x = 10 m, a road of 100 points at y = 10 m."""
    sequence = tmp_path / "log" / "sequences" / "00"
    for folder in ("velodyne", "labels"):
        (sequence / folder).mkdir(parents=True)
    points = np.zeros((200, 4), "<f4")
    points[:100, 0], points[100:, 1] = 10, 10
    points[:, 2] = np.linspace(0, 1, 200)
    for name in ("000000", "000001"):
        points.tofile(sequence / "velodyne" / f"{name}.bin")
    np.repeat([10 | 1 << 16, 40], 100).astype("<u4").tofile(sequence / "labels" / "000000.label")
    (sequence / "calib.txt").write_text("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    return tmp_path / "log"


@pytest.fixture
def labels(log, tmp_path):
    """Labels of both scans: 20 points of the car are taken for road; in the second scan all is void."""
    (scene,) = open_drive(log).scenes
    semantic, instance = np.repeat([CAR, ROAD, ROAD], [80, 20, 100]), np.repeat([3, 0], [80, 120])
    first = ScanLabels(scene.scans[0].token, semantic.astype(np.uint8), instance.astype(np.int32))
    second = ScanLabels(scene.scans[1].token, np.zeros(200, np.uint8), np.zeros(200, np.int32))
    out = tmp_path / "out" / "refined"
    write_scene(out, "nuscenes", scene, [first, second])
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, 3] = 20, 0, 0
    write_poses(tmp_path / "out", [(scene, poses)])
    return out


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def map_of(path):
    """The picture's map, RGB, where it was drawn with 400 pixels."""
    return cv2.imread(str(path))[:, :, ::-1][:, :400]


def place(image, color):
    """Mean (x, y) in metres of the pixels of a colour, for one scan drawn with a radius of 15 m."""
    rows, columns = np.nonzero((image == color).all(axis=2))
    return (columns.mean() - 200) / 13.33, (200 - rows.mean()) / 13.33


def test_figures_as_json(log, labels):
    result = run("evaluate", "--truth", log, "--labels", labels, "--protocol", "nuscenes", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["protocol"] == "nuscenes"
    counts = {"tp": 1, "fp": 0, "fn": 0, "truth_segments": 1, "counted": True}
    assert counts.items() <= figures["classes"]["car"].items()
    assert figures["classes"]["car"]["pq"] == pytest.approx(80)
    assert figures["classes"]["driveable_surface"]["iou"] == pytest.approx(100 / 1.2)
    assert figures["pq"] == pytest.approx((80 + 100 / 1.2) / 2)
    assert figures["pq_things"] == pytest.approx(80)
    assert {"sq", "rq", "miou"} < figures.keys()


def test_the_protocol_of_the_truth_is_the_default_and_the_table_names_it(log, labels):
    result = run("evaluate", "--truth", log, "--labels", labels)
    assert result.exit_code == 0, result.output
    assert "Protocol semantickitti" in result.stdout
    assert "80.0" in result.stdout
    assert "1 scan, 200 points with truth" in " ".join(result.stdout.split())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--protocol", "kitti"], "there is no 'kitti'. Use one of nuscenes, paper, semantickitti."),
        (["--labels", "absent"], "absent: is no folder. Name the folder that holds the label files."),
        (["--scene", "07"], "has no scene '07'. Its scenes are: 00."),
        (["--truth", "absent"], "absent"),
    ],
)
def test_bad_input_ends_with_one_sentence_and_exit_code_2(log, labels, change, message):
    options = {"--truth": log, "--labels": labels} | dict([change])
    result = run("evaluate", *(part for option in options.items() for part in option))
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


def test_scans_without_labels_can_be_left_out(log, labels):
    shutil.copy(log / "sequences/00/labels/000000.label", log / "sequences/00/labels/000001.label")
    (labels / "panoptic" / "00_000001_panoptic.npz").unlink()
    options = ("evaluate", "--truth", log, "--labels", labels, "--json")
    refused = run(*options)
    assert refused.exit_code == 2
    assert "has no 00_000001_panoptic.npz for scan 1 of scene 00" in refused.stderr
    assert json.loads(run(*options, "--skip-missing").stdout)["scans"] == 1


def test_labels_with_another_number_of_points(log, labels):
    points = np.fromfile(log / "sequences/00/velodyne/000000.bin", "<f4")
    points[: 150 * 4].tofile(log / "sequences/00/velodyne/000000.bin")
    truth = np.fromfile(log / "sequences/00/labels/000000.label", "<u4")
    truth[:150].tofile(log / "sequences/00/labels/000000.label")
    sentence = "have 200 values but the scan has 150 points. Were they made from another log?"
    for command in (("evaluate", "--truth", log), ("draw", log, "--out", labels / "x.png")):
        result = run(*command, "--labels", labels)
        assert result.exit_code == 2
        assert sentence in result.stderr
    assert not (labels / "x.png").exists()


def test_a_picture_of_one_scan(log, labels, tmp_path):
    picture = tmp_path / "made" / "scan.png"
    result = run("draw", log, "--labels", labels, "--out", picture, "--radius", 15, "--pixels", 400)
    assert result.exit_code == 0, result.output
    image = map_of(picture)
    assert place(image, CAR_COLOR) == pytest.approx((10, 0), abs=0.3)
    assert place(image, ROAD_COLOR) == pytest.approx((0, 10), abs=0.3)


def test_a_picture_of_the_whole_scene_uses_the_poses_of_the_run(log, labels, tmp_path):
    picture = tmp_path / "scene.png"
    result = run("draw", log, "--labels", labels, "--out", picture, "--whole-scene", "--radius", 15, "--pixels", 400)
    assert result.exit_code == 0, result.output
    image = map_of(picture)  # 50 m wide: 8 pixels a metre, x from -15 m
    columns = np.nonzero((image == VOID).all(axis=2))[1] / 8 - 15
    assert columns.max() == pytest.approx(30, abs=0.5)
    assert columns.min() == pytest.approx(20, abs=0.5)
    (labels.parent / "poses.txt").unlink()
    without = run("draw", log, "--labels", labels, "--out", picture, "--whole-scene")
    assert without.exit_code == 2
    assert "scene 00: has no poses to accumulate its scans by." in without.stderr


def test_a_whole_scene_without_a_run_uses_the_poses_of_the_log(log, labels, tmp_path):
    (labels.parent / "poses.txt").unlink()
    # The car drives 20 m ahead; the world's axes are turned by a quarter against it.
    rows = ["0 -1 0 5 1 0 0 5 0 0 1 0", "0 -1 0 5 1 0 0 25 0 0 1 0"]
    (log / "sequences" / "00" / "poses.txt").write_text("\n".join(rows))
    picture = tmp_path / "scene.png"
    result = run("draw", log, "--labels", labels, "--out", picture, "--whole-scene", "--radius", 15, "--pixels", 400)
    assert result.exit_code == 0, result.output
    columns = np.nonzero((map_of(picture) == VOID).all(axis=2))[1] / 8 - 15
    assert (columns.min(), columns.max()) == pytest.approx((20, 30), abs=0.5)


@pytest.mark.parametrize(
    ("by", "car", "road"),
    [
        ("instance", distinct_colors(np.array([CAR]), np.array([CAR * 1000 + 3]))[0], None),
        ("truth", SEMANTICKITTI19.colors[1], SEMANTICKITTI19.colors[9]),
        ("truth-instance", distinct_colors(np.array([1]), np.array([1]))[0], None),
        ("difference", (255, 64, 64), (60, 150, 110)),
    ],
)
def test_what_the_colors_show(log, labels, tmp_path, by, car, road):
    picture = tmp_path / "x.png"
    options = ("--by", by, "--radius", 15, "--pixels", 400)
    assert run("draw", log, "--labels", labels, "--out", picture, *options).exit_code == 0
    image = map_of(picture)
    assert place(image, car) == pytest.approx((10, 0), abs=0.3)
    if road is not None:
        assert place(image, road) == pytest.approx((0, 10), abs=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "x.gif", "--by", "truth"], "'x.gif' is no .png or .jpg"),
        (["--out", "x.png"], "drawing by class needs labels"),
        (["--out", "x.png", "--by", "truth", "--scan", "2"], "scene 00 has 2 scans, there is no scan 2"),
        (["--out", "x.png", "--by", "truth", "--scan", "1"], "has no truth to draw"),
        (["--out", "x.png", "--by", "truth", "--scene", "a"], "the log has no scene 'a'. Its scenes are: 00."),
    ],
)
def test_what_cannot_be_drawn(log, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("draw", log, *options)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not list(tmp_path.glob("x.*"))
