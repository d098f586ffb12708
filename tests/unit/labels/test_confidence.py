"""Confidence and provenance lie beside the labels, where no reader of the label formats stumbles over them."""

import numpy as np
import pytest

from l3ps.errors import LabelError
from l3ps.labels import ScanLabels, open_labels, read_confidence, read_scan, write_scene

PLACES = {"nuscenes": "confidence/aa_confidence.npz", "semantickitti": "sequences/00/confidence/aa_confidence.npz"}


def labels(confidence=(255, 7, 0), provenance=(1, 3, 0)):
    return ScanLabels(
        "aa",
        np.array([4, 11, 0], np.uint8),
        np.array([1, 0, 0], np.int32),
        confidence=np.array(confidence, np.uint8),
        provenance=np.array(provenance, np.uint8),
    )


@pytest.mark.parametrize(("label_format", "place"), PLACES.items())
def test_they_are_read_back_and_the_labels_too(make_scene, tmp_path, label_format, place):
    scene = make_scene("00", ["aa"])
    written = write_scene(tmp_path, label_format, scene, [labels()])
    assert tmp_path / place in written
    assert set(written) == {path for path in tmp_path.rglob("*") if path.is_file()}
    confidence, provenance = read_confidence(tmp_path / place)
    assert (confidence.tolist(), provenance.tolist()) == ([255, 7, 0], [1, 3, 0])
    folder = open_labels(tmp_path)
    assert folder.format == label_format
    assert read_scan(folder, None, scene, scene.scans[0]).semantic.tolist() == [4, 11, 0]


@pytest.mark.parametrize("label_format", PLACES)
def test_labels_without_them_are_written_as_ever(make_scene, tmp_path, label_format):
    plain = ScanLabels("aa", np.array([4], np.uint8), np.array([1], np.int32))
    write_scene(tmp_path, label_format, make_scene("00", ["aa"]), [plain])
    assert not list(tmp_path.rglob("*confidence*"))


def test_one_byte_a_point_is_insisted_on(make_scene, tmp_path):
    with pytest.raises(ValueError, match="one byte a point"):
        write_scene(tmp_path, "nuscenes", make_scene("00", ["aa"]), [labels(confidence=(1, 2), provenance=(1, 2))])


@pytest.mark.parametrize("content", [b"", b"no archive", None])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "x_confidence.npz"
    if content is None:
        np.savez(path, confidence=np.zeros(3, np.uint8), provenance=np.zeros(2, np.uint8))
    else:
        path.write_bytes(content)
    with pytest.raises(LabelError, match="x_confidence"):
        read_confidence(path)
