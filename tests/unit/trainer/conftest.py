"""Annotated images so simple that a few steps learn them."""

import json

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from l3ps_trainer.annotations import NUSCENES_AND_SKY, Annotated, AnnotationSet


def halves(shift=0):
    """An image whose left part is a bright car and whose right part is dark road."""
    rgb = np.full((48, 96, 3), 40, np.uint8)
    rgb[:, : 48 + shift] = 200
    semantic = np.full((48, 96), 11, np.uint8)
    semantic[:, : 48 + shift] = 4
    return Annotated(rgb, semantic, (semantic == 4).astype(np.int32))


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def image():
    return halves()


@pytest.fixture
def known():
    return AnnotationSet.of(NUSCENES_AND_SKY, [halves(), halves(8)])


@pytest.fixture
def unseen():
    return AnnotationSet.of(NUSCENES_AND_SKY, [halves(-8)])


@pytest.fixture(scope="session")
def graph():
    """Writes a backbone of one convolution."""

    def write(path, size, outputs=8, stride=4):
        weight = np.random.default_rng(0).standard_normal((outputs, 3, stride, stride)).astype(np.float32) * 0.2
        made = helper.make_graph(
            [helper.make_node("Conv", ["picture", "weight"], ["map"], strides=[stride, stride])],
            "backbone",
            [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, *size])],
            [helper.make_tensor_value_info("map", TensorProto.FLOAT, [1, outputs, *(n // stride for n in size)])],
            [onnx.numpy_helper.from_array(weight, "weight")],
        )
        onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
        return path

    return write


@pytest.fixture(scope="session")
def street(tmp_path_factory, graph):
    """A folder with annotated images (a car of two halves on road), others to score on, and a backbone."""
    folder = tmp_path_factory.mktemp("street")
    graph(folder / "backbone.onnx", (32, 64))
    for name, shifts in (("known", (0, 8, -6)), ("unseen", (-8, 5))):
        for part in ("images", "semantic", "instance"):
            (folder / name / part).mkdir(parents=True)
        for number, shift in enumerate(shifts):
            image = halves(shift)
            cv2.imwrite(str(folder / name / "images" / f"{number}.png"), image.rgb)
            cv2.imwrite(str(folder / name / "semantic" / f"{number}.png"), image.semantic)
            cv2.imwrite(str(folder / name / "instance" / f"{number}.png"), image.instance.astype(np.uint16))
    classes = [{"id": 4, "name": "car"}, {"id": 11, "name": "road", "nuscenes": "driveable_surface"}]
    classes.append({"id": 16, "name": "vegetation"})
    (folder / "classes.json").write_text(json.dumps({"classes": classes}))
    return folder
