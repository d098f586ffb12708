"""Folders of labels in every layout, and what is said of those that cannot be used."""

import numpy as np
import pytest

from l3ps.errors import LabelError
from l3ps.labels import ScanLabels, open_labels, read_scan, write_scene


def labels(token, n=5, cls=4):
    return ScanLabels(token, np.full(n, cls, np.uint8), np.ones(n, np.int32))


@pytest.fixture
def scene(make_scene):
    return make_scene("00", ["a", "b"])


def test_formats_are_told_apart_and_panoptic_wins_over_lidarseg(scene, tmp_path):
    write_scene(tmp_path / "kitti", "semantickitti", scene, [labels("a")])
    write_scene(tmp_path / "nu", "nuscenes", scene, [labels("a")])
    assert open_labels(tmp_path / "kitti").format == "semantickitti"
    assert (open_labels(tmp_path / "nu").format, open_labels(tmp_path / "nu").has_instances) == ("nuscenes", True)
    assert not open_labels(tmp_path / "nu" / "lidarseg").has_instances
    assert read_scan(tmp_path / "nu" / "lidarseg", None, scene, scene.scans[0]).instance.tolist() == [0] * 5


def test_a_nuscenes_submission_is_understood(scene, tmp_path):
    (npz, _) = write_scene(tmp_path / "made", "nuscenes", scene, [labels("a")])
    target = tmp_path / "submission" / "panoptic" / "mini_val" / npz.name
    target.parent.mkdir(parents=True)
    npz.rename(target)
    assert read_scan(tmp_path / "submission", None, scene, scene.scans[0]).semantic.tolist() == [4] * 5


def test_sequences_keep_equal_tokens_apart(make_scene, tmp_path):
    scenes = [make_scene(name, ["000000"]) for name in ("00", "08")]
    for cls, scene in zip((4, 10), scenes, strict=True):
        write_scene(tmp_path, "semantickitti", scene, [labels("000000", cls=cls)])
    folder = open_labels(tmp_path)
    assert [int(read_scan(folder, None, s, s.scans[0]).semantic[0]) for s in scenes] == [4, 10]
    other = make_scene("09", ["000000"])
    with pytest.raises(LabelError, match=r"no 000000\.label for scan 0 of scene 09"):
        folder.read(other, other.scans[0])


def test_scans_of_numbered_logs_keep_their_numbers(make_scene, tmp_path):
    scenes = [make_scene(name, [f"{name}_000007"], ["000007"]) for name in ("00", "08")]
    for cls, scene in zip((4, 10), scenes, strict=True):
        (file,) = write_scene(tmp_path, "semantickitti", scene, [labels(f"{scene.name}_000007", cls=cls)])
        assert file == tmp_path / "sequences" / scene.name / "predictions" / "000007.label"
        write_scene(tmp_path / "npz", "nuscenes", scene, [labels(f"{scene.name}_000007", cls=cls)])
    for folder in (open_labels(tmp_path, "semantickitti"), open_labels(tmp_path / "npz")):
        assert [int(read_scan(folder, None, s, s.scans[0]).semantic[0]) for s in scenes] == [4, 10]


def test_predictions_win_over_the_truth_beside_them(scene, tmp_path):
    (made,) = write_scene(tmp_path, "semantickitti", scene, [labels("a", cls=10)])
    truth = made.parent.parent / "labels" / "a.label"
    truth.parent.mkdir()
    truth.write_bytes(b"\0" * 20)
    assert read_scan(tmp_path, None, scene, scene.scans[0]).semantic.tolist() == [10] * 5


def test_moving_and_parked_car_of_one_id_are_one_car(scene, tmp_path):
    file = tmp_path / "a.label"
    np.array([10 | 3 << 16, 252 | 3 << 16, 99 | 5 << 16, 1234], "<u4").tofile(file)
    read = read_scan(tmp_path, None, scene, scene.scans[0])
    assert read.semantic.tolist() == [4, 4, 0, 0]
    assert read.instance[0] == read.instance[1] > 0
    assert read.instance[2] == 0


def test_folders_of_both_results_are_ambiguous(scene, tmp_path):
    for stage in ("primal", "refined"):
        write_scene(tmp_path / stage, "nuscenes", scene, [labels("a")])
    with pytest.raises(LabelError, match=r"holds a_panoptic\.npz twice \(primal/.*refined/"):
        open_labels(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable npz"),
        (b"PK\x03\x04 cut short", "not a readable npz"),
        ({"labels": np.zeros(3, np.uint16)}, "has no array 'data'"),
        ({"data": np.zeros(3)}, "float64"),
        ({"data": np.zeros((3, 2), np.uint16)}, r"shape \(3, 2\)"),
        ({"data": np.array([4001, 24000], np.uint16)}, "24000, whose class 24 is none of 0–16"),
        ({"data": np.array(["x"], object)}, "not a readable npz"),
    ],
)
def test_bad_panoptic_files(scene, tmp_path, content, message):
    file = tmp_path / "a_panoptic.npz"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        np.savez(file, **content)
    with pytest.raises(LabelError, match=message) as caught:
        read_scan(tmp_path, None, scene, scene.scans[0])
    assert str(file) in str(caught.value)


def test_truncated_label_file(scene, tmp_path):
    (tmp_path / "a.label").write_bytes(b"\0" * 21)
    with pytest.raises(LabelError, match="21 bytes, not a multiple of 4"):
        read_scan(tmp_path, None, scene, scene.scans[0])


def test_lidarseg_outside_the_classes(scene, tmp_path):
    (tmp_path / "a_lidarseg.bin").write_bytes(bytes([1, 31]))
    with pytest.raises(LabelError, match="class 31 is none of 0–16"):
        read_scan(tmp_path, None, scene, scene.scans[0])


def test_folders_without_labels(tmp_path):
    with pytest.raises(LabelError, match="is no folder"):
        open_labels(tmp_path / "absent")
    with pytest.raises(LabelError, match=r"holds no label files \(\*_panoptic\.npz, \*\.label, \*_lidarseg\.bin\)"):
        open_labels(tmp_path)
    (tmp_path / "a.label").write_bytes(b"")
    with pytest.raises(LabelError, match=r"holds no label files \(\*_panoptic\.npz, \*_lidarseg\.bin\)"):
        open_labels(tmp_path, "nuscenes")


@pytest.mark.parametrize("token", ["../a", "/etc/passwd", "a/b", "..", "", "a\0b", "a\\b"])
@pytest.mark.parametrize("label_format", ["nuscenes", "semantickitti"])
def test_tokens_from_a_log_cannot_leave_the_folder(make_scene, tmp_path, token, label_format):
    out = tmp_path / "out" / "deep"
    with pytest.raises(LabelError, match="cannot be a file name"):
        write_scene(out, label_format, make_scene("s", [token]), [labels(token)])
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


@pytest.mark.parametrize(
    ("name", "folder"), [("../..", "_"), ("a/b c", "a_b_c"), ("two words", "two words"), ("", "00"), ("...", "00")]
)
def test_scene_names_become_harmless_folders(make_scene, tmp_path, name, folder):
    scene = make_scene(name, ["a"])
    (file,) = write_scene(tmp_path, "semantickitti", scene, [labels("a")])
    assert file == tmp_path / "sequences" / folder / "predictions" / "a.label"
    assert read_scan(tmp_path, None, scene, scene.scans[0]).semantic.tolist() == [4] * 5


def test_a_failing_write_leaves_the_old_file_and_no_part(scene, tmp_path, monkeypatch):
    from l3ps.labels import files

    (npz, _) = write_scene(tmp_path, "nuscenes", scene, [labels("a")])
    before = npz.read_bytes()

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(files.os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        write_scene(tmp_path, "nuscenes", scene, [labels("a", cls=10)])
    assert npz.read_bytes() == before
    assert sorted(p.name for p in npz.parent.iterdir()) == [npz.name]


def test_labels_that_are_not_of_the_scene_are_a_fault_of_the_caller(scene, tmp_path):
    with pytest.raises(ValueError, match="not of scene 00"):
        write_scene(tmp_path, "nuscenes", scene, [labels("z")])
    with pytest.raises(ValueError, match="ids"):
        write_scene(tmp_path, "nuscenes", scene, [ScanLabels("a", np.zeros(3, np.uint8), np.zeros(2, np.int32))])
    with pytest.raises(ValueError, match="0–16"):
        write_scene(tmp_path, "nuscenes", scene, [labels("a", cls=17)])
    with pytest.raises(ValueError, match="choose one of nuscenes, semantickitti"):
        write_scene(tmp_path, "kitti", scene, [])
