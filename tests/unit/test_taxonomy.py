"""Mappings between label spaces agree with each other."""

import numpy as np
import pytest

from l3ps.taxonomy import (
    NUSCENES16,
    NUSCENES16_TO_SEMANTICKITTI19,
    NUSCENES16_TO_SEMANTICKITTI_RAW,
    SEMANTICKITTI19,
    SEMANTICKITTI19_TO_NUSCENES16,
    SEMANTICKITTI_19_TO_RAW,
    pack,
    semantickitti_raw_lut,
    semantickitti_raw_to_nuscenes16_lut,
    unpack,
)


def test_raw_ids_written_are_the_19_classes_meant():
    lut = semantickitti_raw_lut()
    assert lut[list(NUSCENES16_TO_SEMANTICKITTI_RAW)].tolist() == list(NUSCENES16_TO_SEMANTICKITTI19)
    assert lut[list(SEMANTICKITTI_19_TO_RAW)].tolist() == list(range(20))


def test_the_nearest_class_in_the_19_is_a_thing_where_the_class_is_but_for_barrier_and_cone():
    to_19 = np.asarray(NUSCENES16_TO_SEMANTICKITTI19)
    differs = np.flatnonzero(SEMANTICKITTI19.is_thing[to_19] != NUSCENES16.is_thing)
    assert [NUSCENES16.classes[i] for i in differs] == ["barrier", "traffic_cone"]


def test_truth_of_an_other_vehicle_is_a_bus_or_nothing():
    lut = semantickitti_raw_to_nuscenes16_lut()
    assert SEMANTICKITTI19_TO_NUSCENES16[SEMANTICKITTI19.index("other-vehicle")] == 0
    assert {raw: NUSCENES16.classes[lut[raw]] for raw in (13, 257, 20, 16, 10, 252, 253, 60)} == {
        13: "bus", 257: "bus", 20: "void", 16: "void", 10: "car", 252: "car", 253: "bicycle", 60: "driveable_surface",
    }  # fmt: skip


def test_pack_and_unpack():
    semantic, instance = np.array([0, 4, 16]), np.array([0, 999, 0])
    assert pack(semantic, instance).tolist() == [0, 4999, 16000]
    assert [a.tolist() for a in unpack(pack(semantic, instance))] == [[0, 4, 16], [0, 999, 0]]
    with pytest.raises(ValueError, match="1000"):
        pack(semantic, instance + 1)
