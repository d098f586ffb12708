"""The figures measured with the published rules on real recordings come out of label files and logs."""

from dataclasses import replace

import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.evaluate import evaluate_drive
from l3ps.labels import FORMATS, ScanLabels, write_scene

pytestmark = pytest.mark.real

THING_PQ = {
    ("nuscenes-one-keyframe", "scene-0061", "primal"): 34.9,
    ("nuscenes-one-keyframe", "scene-0061", "refined"): 31.0,
    ("urban-surround", "scene-02", "primal"): 29.2,
    ("urban-surround", "scene-02", "refined"): 30.4,
}


@pytest.mark.parametrize("label_format", FORMATS)
@pytest.mark.parametrize(("log", "scene", "side"), THING_PQ)
def test_thing_pq(real_data, tmp_path, log, scene, side, label_format):
    drive = open_drive(real_data / "data" / log)
    chosen = next(s for s in drive.scenes if s.name == scene)
    (recorded,) = (real_data / "golden").glob(f"{log}*.npz")
    with np.load(recorded) as golden:
        of_scan = [golden["frame"] == frame for frame in range(len(chosen.scans))]
        labels = [
            ScanLabels(scan.token, golden[f"{side}_semantic"][m], golden[f"{side}_instance"][m].astype(np.int32))
            for scan, m in zip(chosen.scans, of_scan, strict=True)
        ]
    write_scene(tmp_path, label_format, chosen, labels)
    quality = evaluate_drive(replace(drive, scenes=(chosen,)), tmp_path, "nuscenes")
    assert quality.pq_things == pytest.approx(THING_PQ[log, scene, side], abs=0.05)
    assert quality.pq == quality.pq_things, "these logs have truth for things only"
