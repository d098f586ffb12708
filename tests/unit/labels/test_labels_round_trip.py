"""What is written is what is read, and what other tools will find in the files."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from l3ps.labels import ScanLabels, open_labels, read_scan, write_scene
from l3ps.taxonomy import NUSCENES16, NUSCENES16_TO_SEMANTICKITTI19

IDS = st.sampled_from([0, 1, 2, 3, 41, 999, 1000, 70_000, 2**31 - 1])


@st.composite
def scene_labels(draw):
    """Up to four scans whose ids keep to ScanLabels' rule: one id never names two objects of a scan."""
    scans = []
    for number in range(draw(st.integers(0, 4))):
        n = draw(st.integers(0, 60))
        semantic = draw(arrays(np.uint8, n, elements=st.integers(0, 16)))
        instance = draw(arrays(np.int32, n, elements=IDS))
        owner = {}
        for i, (cls, name) in enumerate(zip(semantic.tolist(), instance.tolist(), strict=True)):
            if owner.setdefault(name, cls) != cls:
                instance[i] = 0
        scans.append(ScanLabels(f"{number:06d}", semantic, instance))
    return scans


def objects(semantic, instance):
    """Things as point sets, whatever their ids: {(class, frozenset of points)}."""
    keys = {(c, z) for c, z in zip(semantic.tolist(), instance.tolist(), strict=True) if z}
    return {(c, frozenset(np.flatnonzero((semantic == c) & (instance == z)).tolist())) for c, z in keys}


def things_only(scan):
    return np.where(NUSCENES16.is_thing[scan.semantic], scan.instance, 0)


@settings(max_examples=60, deadline=None)
@given(labels=scene_labels())
def test_nuscenes_round_trip(make_scene, labels):
    scene = make_scene("scene-0061", [scan.token for scan in labels])
    with tempfile.TemporaryDirectory() as folder:
        files = write_scene(Path(folder), "nuscenes", scene, labels)
        assert len(files) == 2 * len(labels)
        for scan, written in zip(scene.scans, labels, strict=True):
            read = read_scan(Path(folder), None, scene, scan)
            assert read.token == written.token
            assert read.semantic.dtype == np.uint8 and read.instance.dtype == np.int32
            assert np.array_equal(read.semantic, written.semantic)
            assert objects(read.semantic, read.instance) == objects(written.semantic, things_only(written))
            lidarseg = Path(folder, "lidarseg", f"{scan.token}_lidarseg.bin")
            assert np.array_equal(np.fromfile(lidarseg, np.uint8), written.semantic)


@settings(max_examples=60, deadline=None)
@given(labels=scene_labels())
def test_semantickitti_round_trip_in_its_19_classes(make_scene, labels):
    scene = make_scene("00", [scan.token for scan in labels])
    to_19 = np.asarray(NUSCENES16_TO_SEMANTICKITTI19)
    with tempfile.TemporaryDirectory() as folder:
        write_scene(Path(folder), "semantickitti", scene, labels)
        for scan, written in zip(scene.scans, labels, strict=True):
            semantic, instance = open_labels(Path(folder)).read(scene, scan, "semantickitti")
            assert np.array_equal(semantic, to_19[written.semantic])
            expected = np.where((semantic >= 1) & (semantic <= 8), written.instance, 0)
            seen = np.where((semantic >= 1) & (semantic <= 8), instance, 0)
            assert objects(semantic, seen) == objects(semantic, expected)


def test_semantickitti_keeps_the_classes_it_can_tell_apart(make_scene, tmp_path):
    scene = make_scene("00", ["000000"])
    classes = np.arange(17, dtype=np.uint8)
    write_scene(tmp_path, "semantickitti", scene, [ScanLabels("000000", classes, np.arange(17, dtype=np.int32))])
    read = read_scan(tmp_path, None, scene, scene.scans[0]).semantic
    lost = {"barrier": "manmade", "construction_vehicle": "void", "traffic_cone": "void", "trailer": "void"}
    assert {NUSCENES16.classes[c]: NUSCENES16.classes[r] for c, r in zip(classes, read, strict=True) if c != r} == lost


def test_files_are_what_the_formats_prescribe(make_scene, tmp_path):
    scene = make_scene("scene-0061", ["aa"])
    labels = [ScanLabels("aa", np.array([0, 4, 4, 16, 1], np.uint8), np.array([0, 12, 0, 7, 3], np.int32))]
    names = [file.relative_to(tmp_path).as_posix() for file in write_scene(tmp_path, "nuscenes", scene, labels)]
    assert names == ["panoptic/aa_panoptic.npz", "lidarseg/aa_lidarseg.bin"]
    with np.load(tmp_path / names[0]) as archive:
        assert archive.files == ["data"]
        assert archive["data"].dtype == np.uint16
        assert archive["data"].tolist() == [0, 4012, 4000, 16000, 1003]  # stuff carries no id
    (label,) = write_scene(tmp_path, "semantickitti", scene, labels)
    assert label.relative_to(tmp_path).as_posix() == "sequences/scene-0061/predictions/aa.label"
    raw = np.fromfile(label, "<u4")
    assert [(int(v) & 0xFFFF, int(v) >> 16) for v in raw] == [(0, 0), (10, 12), (10, 0), (70, 0), (51, 0)]


def test_the_same_labels_give_the_same_bytes(make_scene, tmp_path):
    scene = make_scene("s", ["aa"])
    labels = [ScanLabels("aa", np.full(50, 4, np.uint8), np.arange(50, dtype=np.int32))]
    for name in ("first", "second"):
        write_scene(tmp_path / name, "nuscenes", scene, labels)
    first, second = ((tmp_path / name / "panoptic/aa_panoptic.npz").read_bytes() for name in ("first", "second"))
    assert first == second


def test_large_ids_are_renumbered_the_same_way_through_the_scene(make_scene, tmp_path):
    scene = make_scene("s", ["a", "b"])
    labels = [
        ScanLabels("a", np.array([4, 4, 10, 16], np.uint8), np.array([5000, 7, 5001, 0], np.int32)),
        ScanLabels("b", np.array([4, 4, 10, 4], np.uint8), np.array([7, 5000, 5001, 0], np.int32)),
    ]
    write_scene(tmp_path, "nuscenes", scene, labels)
    data = [np.load(tmp_path / f"panoptic/{t}_panoptic.npz")["data"].tolist() for t in "ab"]
    assert data == [[4002, 4001, 10001, 16000], [4001, 4002, 10001, 4000]]


def test_classes_that_become_one_share_its_numbers(make_scene, tmp_path):
    scene = make_scene("s", ["a"])
    vehicles = ScanLabels("a", np.array([9, 5, 9, 3], np.uint8), np.array([70_000, 70_001, 0, 7], np.int32))
    (file,) = write_scene(tmp_path, "semantickitti", scene, [vehicles])
    assert [(int(v) & 0xFFFF, int(v) >> 16) for v in np.fromfile(file, "<u4")] == [(20, 2), (20, 3), (20, 0), (13, 1)]


def test_more_objects_than_the_format_can_number_is_an_error_that_leaves_nothing(make_scene, tmp_path):
    from l3ps.errors import LabelError

    scene = make_scene("long", ["a", "b"])
    labels = [ScanLabels(t, np.full(1000, 4, np.uint8), np.arange(1, 1001, dtype=np.int32)) for t in "ab"]
    with pytest.raises(LabelError, match=r"scene long: has 1,000 instances of car, the label format holds 999"):
        write_scene(tmp_path, "nuscenes", scene, labels)
    assert list(tmp_path.rglob("*")) == []
    for scan in labels:
        scan.instance[0] = 2
    assert len(write_scene(tmp_path, "nuscenes", scene, labels)) == 4


def test_where_numbers_run_out_only_objects_of_one_scan_share_them(make_scene, tmp_path):
    """A scene has more objects than the format numbers, but no scan has: those seen again keep their own."""
    scene = make_scene("long", ["a", "b", "c"])
    of_scan = [[*range(1, 301), *range(1000 * k, 1000 * k + 400)] for k in (1, 2, 3)]
    labels = [
        ScanLabels(t, np.full(700, 4, np.uint8), np.array(ids, np.int32)) for t, ids in zip("abc", of_scan, strict=True)
    ]
    write_scene(tmp_path, "nuscenes", scene, labels)
    written = [np.load(tmp_path / f"panoptic/{t}_panoptic.npz")["data"] - 4000 for t in "abc"]
    assert all(len(set(ids.tolist())) == 700 and ids.max() <= 999 for ids in written)
    assert all((ids[:300] == written[0][:300]).all() for ids in written)
    assert not set(written[0][:300].tolist()) & set(written[1][300:].tolist())
