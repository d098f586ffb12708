"""Model bundles: what is accepted, and what a user is told about the rest."""

import json
import os
import zipfile

import pytest

from l3ps.errors import ModelError
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.session import Segmenter


def zipped(folder, target, prefix=""):
    with zipfile.ZipFile(target, "w") as archive:
        for file in folder.iterdir():
            archive.write(file, prefix + file.name)
    return target


def test_directory_zip_and_zip_with_top_folder_are_the_same_bundle(write_bundle, tmp_path):
    folder = write_bundle()
    loaded = [
        ModelBundle.load(folder),
        ModelBundle.load(zipped(folder, tmp_path / "flat.zip")),
        ModelBundle.load(zipped(folder, tmp_path / "nested.zip", "export/")),
        ModelBundle.from_bytes(zipped(folder, tmp_path / "bytes.zip").read_bytes()),
    ]
    assert len({bundle.sha256 for bundle in loaded}) == 1
    assert loaded[0].info.lut.tolist() == [4, 16, 11]


def test_about_json_is_read_where_there_is_no_model_json(write_bundle):
    assert ModelBundle.load(write_bundle(description_name="about.json")).info.name == "colours"


def test_the_digest_changes_with_the_mapping(write_bundle):
    first = ModelBundle.load(write_bundle())
    other = write_bundle.description(to_nuscenes={"car": 10, "vegetation": 16, "road": 11})
    assert ModelBundle.load(write_bundle(info=other, name="other")).sha256 != first.sha256


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"to_nuscenes": {"car": 4}}, "lacks the classes vegetation, road"),
        ({"to_nuscenes": {"car": 17, "vegetation": 16, "road": 11}}, r"\[17\]"),
        ({"classes": []}, "classes"),
        ({"name": "../../etc"}, "name"),
        ({"classes": ["car\0"], "to_nuscenes": {"car\0": 4}}, r"classes\.0: .*1 to 100 printable characters"),
        ({"to_nuscenes": {"car\ud800": 4}}, r"to_nuscenes\.car.*printable"),
        ({"classes": ["c" * 101], "to_nuscenes": {"c" * 101: 4}}, "1 to 100 printable"),
        ({"output": {"semantic": "logits\0"}}, r"output\.semantic: .*printable"),
        ({"input": {"name": "image", "height": 0, "width": 64}}, "input.height"),
        ({"input": {"name": "image", "height": 32, "width": 64, "std": [0, 1, 1]}}, "std must be positive"),
        ({"label_space": "ade20k"}, "label_space"),
    ],
)
def test_a_wrong_description_is_named(write_bundle, change, expected):
    with pytest.raises(ModelError, match=expected):
        ModelBundle.load(write_bundle(info=write_bundle.description(**change)))


def test_what_is_no_bundle_is_refused_in_one_sentence(write_bundle, tmp_path):
    folder = write_bundle()
    (tmp_path / "text.zip").write_text("hello")
    (folder / "model.json").write_text("{")
    empty = tmp_path / "empty"
    empty.mkdir()
    for path, expected in [
        (tmp_path / "nowhere", "no such file"),
        (tmp_path / "text.zip", "neither a directory nor a readable zip"),
        (folder, "not valid JSON"),
        (empty, "holds no model.json"),
    ]:
        with pytest.raises(ModelError, match=expected):
            ModelBundle.load(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"input": {"name": "x", "height": 32, "width": 64}}, "no input 'x' .it has image"),
        ({"output": {"semantic": "probs"}}, "no output 'probs' .it has logits"),
        ({"input": {"name": "image", "height": 48, "width": 64}}, "the graph takes"),
    ],
)
def test_a_description_that_does_not_fit_the_graph_is_refused(write_bundle, change, expected):
    bundle = ModelBundle.load(write_bundle(info=write_bundle.description(**change)))
    with pytest.raises(ModelError, match=expected):
        Segmenter(bundle)


def test_a_broken_graph_is_refused(write_bundle):
    with pytest.raises(ModelError, match="onnxruntime cannot load the graph"):
        Segmenter(ModelBundle.load(write_bundle(graph=b"not a graph")))


def test_deeply_nested_json_is_refused(write_bundle):
    folder = write_bundle()
    (folder / "model.json").write_text("[" * 100_000)
    with pytest.raises(ModelError):
        ModelBundle.load(folder)
    (folder / "model.json").write_text(json.dumps([1, 2]))
    with pytest.raises(ModelError):
        ModelBundle.load(folder)


def test_the_runtime_is_told_not_to_report_its_use():
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"
