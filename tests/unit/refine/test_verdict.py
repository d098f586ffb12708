"""What each label says of itself: how sure it is, and where it comes from."""

import numpy as np
import pytest

from l3ps.labels.types import Provenance, ScanLabels
from l3ps.presets import PRESETS
from l3ps.refine.verdict import Verdict, decide, of_objects
from l3ps.taxonomy import NUSCENES16

CAR, TRUCK, ROAD = (NUSCENES16.index(name) for name in ("car", "truck", "driveable_surface"))


def settled(before, after, instance, confidence=200):
    n = len(before)
    verdict = Verdict(
        np.array(before, np.uint8), np.full(n, confidence, np.uint8), np.full(n, Provenance.CAMERA, np.uint8)
    )
    return of_objects(verdict, np.array(after, np.uint8), np.array(instance, np.int32))


def test_a_point_whose_object_changed_its_class_is_as_sure_as_the_object_is_of_one_mind():
    found = settled([CAR] * 3 + [TRUCK] + [ROAD], [CAR] * 4 + [ROAD], [1] * 4 + [0])
    assert found.semantic.tolist() == [CAR] * 4 + [ROAD]
    assert found.confidence.tolist() == [200, 200, 200, 191, 200], "three of four points spoke for a car"
    assert found.provenance.tolist() == [Provenance.CAMERA] * 3 + [Provenance.INSTANCE_RULE, Provenance.CAMERA]


def test_objects_that_change_nothing_leave_every_point_as_sure_as_it_was():
    found = settled([CAR, TRUCK], [CAR, TRUCK], [1, 2])
    assert found.confidence.tolist() == [200, 200]
    assert found.provenance.tolist() == [Provenance.CAMERA] * 2


@pytest.mark.parametrize("preset", ["paper", "best"])
def test_noise_says_that_it_took_the_class_of_its_neighbours_cluster(preset):
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(0, 0.3, (40, 3)), [[2.0, 2.0, 2.0]]]).astype(np.float32)
    noise = np.arange(41) == 40
    primal = ScanLabels("s", np.where(noise, 0, CAR).astype(np.uint8), np.zeros(41, np.int32))
    verdict = decide(points, np.zeros(41, bool), np.zeros(41, np.int32), noise, [primal], PRESETS[preset])
    assert verdict.semantic[40] == CAR
    assert verdict.provenance[40] == Provenance.NOISE_FILL
    assert verdict.provenance[0] == Provenance.CAMERA
    assert 0 < verdict.confidence[40] <= verdict.confidence[0]
