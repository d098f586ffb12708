"""Our figures are the official ones: same counts, same per-class figures, same label mapping."""

import numpy as np
import pytest

from l3ps.drivelog.types import Truth
from l3ps.evaluate import PROTOCOLS, PanopticEvaluator
from l3ps.taxonomy import NUSCENES16, NUSCENES_RAW_INDEX, nuscenes_raw_lut

pytestmark = pytest.mark.slow


def random_scan(rng, n_classes, points=20_000):
    """A scan of segments from 1 point up, and a prediction that splits, merges, confuses and forgets them."""
    sizes = np.maximum(rng.geometric(0.012, 4 * points // 80), 1)
    segment = np.repeat(np.arange(len(sizes)), sizes)[:points]
    t_sem = rng.integers(0, n_classes, len(sizes))[segment]
    t_inst = rng.integers(0, 40, len(sizes))[segment]  # ids repeat between classes and within one: merged segments
    renamed = rng.integers(0, 40, len(sizes))[segment]
    p_sem = np.where(rng.random(len(sizes))[segment] < 0.15, rng.integers(0, n_classes, len(sizes))[segment], t_sem)
    noise = rng.random(len(segment))
    p_sem = np.where(noise < 0.1, rng.integers(0, n_classes, len(segment)), p_sem)
    p_inst = np.where(noise > 0.8, rng.integers(0, 3, len(segment)), renamed)
    return t_sem.astype(np.uint8), t_inst.astype(np.int32), p_sem.astype(np.uint8), p_inst.astype(np.int32)


def save(path, scans):
    keys = ("t_sem", "t_inst", "p_sem", "p_inst")
    arrays = {
        f"{key}_{i}": a.astype(np.int64) for i, scan in enumerate(scans) for key, a in zip(keys, scan, strict=True)
    }
    np.savez(path, **arrays)
    return str(path)


def assert_same(evaluator, reference):
    classes = list(evaluator.quality().classes.values())
    for name in ("tp", "fp", "fn"):
        assert [getattr(c, name) for c in classes] == reference[name][1:], name
    for name in ("pq", "sq", "rq", "iou"):
        ours = [getattr(c, name) for c in classes]
        np.testing.assert_allclose(ours, 100 * np.asarray(reference[name][1:]), rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("protocol", list(PROTOCOLS))
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_panoptics(devkit, tmp_path, protocol, seed):
    rules = PROTOCOLS[protocol]
    rng = np.random.default_rng(seed)
    n_classes = len(rules.space.classes)
    scans = [random_scan(rng, n_classes) for _ in range(4)]
    evaluator = PanopticEvaluator(protocol)
    for t_sem, t_inst, p_sem, p_inst in scans:
        evaluator.add(Truth(t_sem, t_inst), p_sem, p_inst)
    if rules.ignore_predicted_void:  # the official evaluator has no such rule: leave the points out beforehand
        scans = [tuple(array[scan[2] != 0] for array in scan) for scan in scans]
    reference = devkit(
        what="figures", npz=save(tmp_path / "scans.npz", scans), classes=n_classes, min_points=rules.min_points
    )
    assert sum(reference["tp"]) > 50 and sum(reference["fp"]) > 50 and sum(reference["fn"]) > 50
    assert_same(evaluator, reference)
    # All classes are present, so our mean is the official one.
    assert all(c.truth_segments for c in evaluator.quality().classes.values())
    assert evaluator.quality().pq == pytest.approx(100 * np.mean(reference["pq"][1:]), abs=1e-9)
    assert evaluator.quality().miou == pytest.approx(100 * np.mean(reference["iou"][1:]), abs=1e-9)


def test_taxonomy_is_the_devkits(devkit):
    reference = devkit(what="taxonomy", names=NUSCENES_RAW_INDEX)
    lut = nuscenes_raw_lut({name: index for index, name in enumerate(NUSCENES_RAW_INDEX)})
    assert {int(k): v for k, v in reference["raw_to_class"].items()} == dict(enumerate(lut[:32].tolist()))
    named = {name if index else "ignore": index for index, name in enumerate(NUSCENES16.classes)}
    assert reference["classes"] == named
    assert {name: tuple(c) for name, c in reference["colors"].items()} == dict(
        zip(named, NUSCENES16.colors, strict=True)
    )
