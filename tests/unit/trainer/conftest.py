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


def official_weights(registers=False, side=37, width=24, depth=1):
    """Random weights in DINOv2's own naming."""
    make = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(shape, generator=make) * 0.1

    state = {
        "cls_token": normal(1, 1, width), "mask_token": normal(1, width), "pos_embed": normal(1, side**2 + 1, width),
        "patch_embed.proj.weight": normal(width, 3, 14, 14), "patch_embed.proj.bias": normal(width),
        "norm.weight": 1 + normal(width), "norm.bias": normal(width),
    }  # fmt: skip
    for block in range(depth):
        shapes = {
            "norm1.weight": (width,), "norm1.bias": (width,), "norm2.weight": (width,), "norm2.bias": (width,),
            "attn.qkv.weight": (3 * width, width), "attn.qkv.bias": (3 * width,), "attn.proj.weight": (width, width),
            "attn.proj.bias": (width,), "ls1.gamma": (width,), "ls2.gamma": (width,),
            "mlp.fc1.weight": (4 * width, width), "mlp.fc1.bias": (4 * width,), "mlp.fc2.weight": (width, 4 * width),
            "mlp.fc2.bias": (width,),
        }  # fmt: skip
        state |= {f"blocks.{block}.{name}": normal(*shape) for name, shape in shapes.items()}
    if registers:
        state["register_tokens"] = normal(1, 4, width)
    return state


@pytest.fixture(scope="session")
def official():
    return official_weights
