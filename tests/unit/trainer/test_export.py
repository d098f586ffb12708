"""Heads, the graph for both of them, and what int8 may cost."""

import numpy as np
import onnx
import pytest
import torch
from torch.nn import functional as f

from l3ps.errors import ProcessingError
from l3ps_trainer.backbones import DinoV2
from l3ps_trainer.export import Network, agreement, write_graph
from l3ps_trainer.heads import HEADS, Pointwise, output_sizes
from l3ps_trainer.quantise import quantise
from l3ps_trainer.validation import Confusion

SMALL = {"depth": 1, "embed_dim": 24, "num_heads": 2}


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    backbone = DinoV2("dinov2-s-reg", None, (42, 70), **SMALL)
    return Network(backbone, HEADS["published"](24, 5, boundary=True, stride=14))


@pytest.fixture(scope="module")
def exported(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("graph") / "model.onnx"
    write_graph(network, path)
    return path


def noise(seed=1):
    return np.random.default_rng(seed).standard_normal((1, 3, 42, 70)).astype(np.float32)


def test_the_first_convolution_before_enlarging_gives_what_it_gives_after():
    torch.manual_seed(0)
    head, features = Pointwise(6, (5, 4), 3, 14), torch.randn(1, 6, 3, 5)
    enlarged = f.interpolate(features, scale_factor=14, mode="bilinear", align_corners=False)
    x = head.layers[0](enlarged)
    for layer in head.layers[1:]:
        x = layer(f.relu(x))
    assert torch.allclose(head(features), x, atol=1e-5)


def test_published_heads_answer_at_the_published_resolutions():
    heads = HEADS["published"](768, 18, boundary=True, stride=14)
    assert output_sizes(heads, 768, (64, 114)) == ((896, 1596), (256, 456))
    assert [layer.out_channels for layer in heads.semantic.layers] == [300, 300, 200, 18]
    assert [layer.out_channels for layer in heads.boundary.layers] == [600, 600, 400, 1]


def test_narrow_heads_cost_little_beside_a_vit_s():
    heads = HEADS["narrow"](384, 18, boundary=True, stride=14)
    products = 0
    for head in (heads.semantic, heads.boundary):
        first, *rest = (layer.weight.numel() for layer in head.layers)
        products += 32 * 57 * first + 128 * 228 * sum(rest)
    tokens, width = 32 * 57 + 1, 384
    backbone = 12 * (12 * tokens * width**2 + 2 * tokens**2 * width)
    assert products < 0.1 * backbone


def test_one_graph_serves_both_heads_and_gives_what_torch_gives(network, exported):
    found = agreement(network, exported, [noise()], threads=1)
    assert found.probability <= 1e-3
    assert found.equal >= 0.999
    graph = onnx.load(exported).graph
    shapes = {o.name: [d.dim_value for d in o.type.tensor_type.shape.dim] for o in graph.output}
    assert shapes == {"semantic": [1, 4, 12, 20], "boundary": [1, 1, 12, 20]}, "without void, at 4/14 of the input"
    assert [d.dim_value for d in graph.input[0].type.tensor_type.shape.dim] == [1, 3, 42, 70]
    assert {node.op_type for node in graph.node if node.domain not in ("", "ai.onnx")} == {"MultiHeadAttention"}
    assert not any(node.op_type in ("Softmax", "If", "Loop") for node in graph.node)


def test_a_graph_that_differs_is_not_delivered(network, exported, tmp_path):
    spoilt = onnx.load(exported)
    for tensor in spoilt.graph.initializer:
        if len(tensor.dims) == 4:
            values = onnx.numpy_helper.to_array(tensor) * 1.5
            tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
    onnx.save(spoilt, tmp_path / "spoilt.onnx")
    with pytest.raises(ProcessingError, match=r"spoilt\.onnx is not the network that was trained"):
        agreement(network, tmp_path / "spoilt.onnx", [noise()], threads=1)


def test_weights_beyond_what_a_graph_file_holds_lie_beside_it(network, tmp_path, monkeypatch):
    monkeypatch.setattr("l3ps_trainer.export.LARGEST_FILE", 1000)
    write_graph(network, tmp_path / "model.onnx")
    assert {p.name for p in tmp_path.iterdir()} == {"model.onnx", "model.onnx.data"}
    assert agreement(network, tmp_path / "model.onnx", [noise()], threads=1).probability <= 1e-3


def test_int8_makes_the_products_small_and_leaves_the_convolutions(exported, tmp_path):
    quantise(exported, tmp_path / "int8.onnx")
    kinds = [node.op_type for node in onnx.load(tmp_path / "int8.onnx").graph.node]
    assert kinds.count("MatMulInteger") == 4, "qkv, projection and the two layers of the perceptron"
    assert "ConvInteger" not in kinds
    assert "Conv" in kinds


def test_iou_by_hand():
    confusion = Confusion(4)
    truth = np.array([[1, 1, 2, 0]], np.uint8)
    logits = np.zeros((3, 1, 4), np.float32)
    logits[[0, 1, 1, 2], 0, [0, 1, 2, 3]] = 1  # found: 1, 2, 2 and 3 where nothing is annotated
    confusion.add(truth, logits)
    assert confusion.iou()[1:3].tolist() == [50, 50]
    assert np.isnan(confusion.iou()[[0, 3]]).all()
    assert confusion.miou() == 50


def test_logits_are_enlarged_before_the_class_is_chosen():
    confusion = Confusion(3)
    logits = np.array([[[1.0, -1.0]], [[0.0, 0.0]]], np.float32)
    confusion.add(np.array([[1, 1, 1, 2, 2, 2]], np.uint8), logits)
    assert confusion.miou() == 100
