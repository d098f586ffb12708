"""Real recordings: log reader, label files and evaluator against the official loading and counting."""

import json

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.evaluate import evaluate_drive
from l3ps.labels import ScanLabels, open_labels, write_scene
from l3ps.taxonomy import semantickitti_raw_lut

pytestmark = [pytest.mark.slow, pytest.mark.real]


def spoiled(truth, rng):
    """Labels like a method's: some objects and regions of another class, some cut in two, some joined, some void."""
    semantic, instance = truth.semantic.copy(), truth.instance.copy()
    segment = np.unique(np.stack((semantic, instance)), axis=1, return_inverse=True)[1].reshape(-1)
    fate = rng.random(segment.max() + 1)[segment]
    point = rng.random(len(segment))
    instance = np.where(fate < 0.2, instance * (point < 0.6), instance)
    instance = np.where((fate > 0.2) & (fate < 0.3), 7, instance)
    semantic = np.where(fate > 0.85, 1 + (semantic + 3) % 16, semantic)
    semantic = np.where(point > 0.9, rng.integers(0, 17, len(segment)), semantic)
    # one id never names two objects of a scan
    return semantic.astype(np.uint8), np.where(instance > 0, instance + semantic * 40_000, 0).astype(np.int32)


def assert_same(quality, reference):
    classes = list(quality.classes.values())
    for name in ("tp", "fp", "fn"):
        assert [getattr(c, name) for c in classes] == reference[name][1:], name
    for name in ("pq", "sq", "rq", "iou"):
        ours = [getattr(c, name) for c in classes]
        np.testing.assert_allclose(ours, 100 * np.asarray(reference[name][1:]), rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("name", ["nuscenes-one-keyframe", "urban-surround"])
def test_nuscenes_logs(devkit, real_data, tmp_path, name):
    log = real_data / "data" / name
    drive = open_drive(log)
    rng = np.random.default_rng(4)
    files = []
    for scene in drive.scenes:
        labels = [ScanLabels(scan.token, *spoiled(scan.load_truth(), rng)) for scan in scene.scans]
        write_scene(tmp_path, "nuscenes", scene, labels)
        for scan in scene.scans:
            made = tmp_path / "panoptic" / f"{scan.token}_panoptic.npz"
            files.append((str(log / "panoptic" / "v1.0-mini" / made.name), str(made)))
    categories = json.loads((log / "v1.0-mini" / "category.json").read_text())
    names = [c["name"] for c in sorted(categories, key=lambda c: c["index"])]
    reference = devkit(what="figures", files=files, names=names, classes=17, min_points=15)
    assert sum(reference["tp"]) > 10 and sum(reference["fp"]) > 1 and sum(reference["fn"]) > 1
    assert_same(evaluate_drive(drive, tmp_path, "nuscenes"), reference)


def test_semantickitti_log(devkit, real_data, tmp_path):
    """semantic-kitti-api evaluates by the same counting, with its own loading (evaluate_panoptic.py)."""
    log = real_data / "data" / "semantickitti-one-scan"
    drive = open_drive(log)
    (scene,) = drive.scenes
    (scan,) = scene.scans
    raw = np.fromfile(log / "sequences" / "08" / "labels" / "000000.label", "<u4")
    rng = np.random.default_rng(5)
    predicted = raw.copy()
    classes = np.array([0, 10, 11, 30, 40, 48, 50, 70, 72, 80], "<u4")
    wrong = rng.random(len(raw)) < 0.2
    predicted[wrong] = rng.choice(classes, wrong.sum()) | rng.integers(0, 3, wrong.sum()).astype("<u4") << 16
    made = tmp_path / "sequences" / "08" / "predictions" / "000000.label"
    made.parent.mkdir(parents=True)
    predicted.tofile(made)
    lut = semantickitti_raw_lut()
    columns = {
        f"{side}_{part}_0": values.astype(np.int64)
        for side, file in (("t", raw), ("p", predicted))
        for part, values in (("sem", lut[file & 0xFFFF]), ("inst", file >> 16))
    }
    np.savez(tmp_path / "scan.npz", **columns)
    reference = devkit(what="figures", npz=str(tmp_path / "scan.npz"), classes=20, min_points=50)
    assert sum(reference["tp"]) > 10 and sum(reference["fp"]) > 5
    assert_same(evaluate_drive(drive, open_labels(tmp_path), "semantickitti"), reference)
    assert scan.number == "000000"
