"""What is refused before anything is trained."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from l3ps.errors import InputError
from l3ps_trainer.annotations import NUSCENES_AND_SKY, Annotated, AnnotationSet, ClassSet
from l3ps_trainer.backbones import DinoV2, OnnxGraph, Scratch
from l3ps_trainer.backbones.dinov2 import read_state
from l3ps_trainer.checks import check_apart, check_classes, check_name, check_out, fingerprints


def picture(value):
    return Annotated(np.full((4, 6, 3), value, np.uint8), np.ones((4, 6), np.uint8), None)


@pytest.mark.parametrize("name", ["mein modell", "../x", "", "a" * 101, "-x"])
def test_a_name_that_no_bundle_may_have_is_refused_at_once(name):
    with pytest.raises(InputError, match="no name of a model"):
        check_name(name)


def test_a_folder_with_files_that_no_training_wrote_is_left_alone(tmp_path):
    work = tmp_path / ".training"
    check_out(tmp_path, work)
    work.mkdir()
    check_out(tmp_path, work)
    (tmp_path / "report.md").write_text("mine")
    with pytest.raises(InputError, match="not by a training"):
        check_out(tmp_path, work)
    (work / "checkpoint.pt").touch()
    check_out(tmp_path, work)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(InputError, match="in use"):
        check_out(file, file / ".training")


def test_images_are_known_by_what_they_show():
    ours = AnnotationSet.of(NUSCENES_AND_SKY, [picture(1), picture(2)])
    others = AnnotationSet.of(NUSCENES_AND_SKY, [picture(3), picture(2)])
    assert fingerprints(ours)[0] != fingerprints(others)[0]
    with pytest.raises(InputError, match="1 of its 2 images are training images"):
        check_apart(fingerprints(ours), fingerprints(others))


def test_classes_of_which_none_labels_a_point_are_refused():
    check_classes(AnnotationSet.of(NUSCENES_AND_SKY, [picture(1)]))
    with pytest.raises(InputError, match="every class counts as void"):
        check_classes(AnnotationSet.of(ClassSet(("void", "sky"), (0, 0)), [picture(1)]))


def test_a_second_size_that_the_backbone_cannot_take_is_refused_under_its_option():
    with pytest.raises(InputError, match=r"--balanced.*multiple of 16. Take 672x1184"):
        Scratch((32, 64)).check((672, 1190), "--balanced")
    with pytest.raises(InputError, match=r"--balanced.*no multiple"):
        DinoV2("dinov2-s", None, (14, 14), depth=1).check((16, 16), "--balanced")


def test_a_text_in_place_of_weights_is_told_as_such(tmp_path):
    (tmp_path / "weights.pth").write_text("hi")
    with pytest.raises(InputError, match="cannot be read as a torch state dict"):
        read_state(tmp_path / "weights.pth")


@pytest.mark.parametrize(
    ("operator", "kind", "told"),
    [("Cast", TensorProto.INT64, "returns int64"), ("Log", TensorProto.FLOAT, "not finite")],
)
def test_a_graph_whose_features_are_none_is_refused_before_it_is_used(tmp_path, operator, kind, told):
    options = {"to": kind} if operator == "Cast" else {}
    minus = helper.make_node("Neg", ["image"], ["minus"])
    node = helper.make_node(operator, ["minus"], ["features"], **options)
    shape = [1, 3, 8, 8]
    graph = helper.make_graph(
        [minus, node],
        "g",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("features", kind, shape)],
    )
    path = Path(tmp_path, "graph.onnx")
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)
    with pytest.raises(InputError, match=told):
        OnnxGraph(path, None)
