"""Backbones: the published position embedding, weights that fit or are refused, any graph with a feature map."""

import math

import pytest
import torch
from torch.nn import functional as f

from l3ps.errors import ModelError
from l3ps_trainer.backbones import DinoV2, OnnxGraph, open_backbone
from l3ps_trainer.backbones.dinov2 import resized_positions

SMALL = {"depth": 1, "embed_dim": 24, "num_heads": 2}
"""A DINOv2 of one narrow block."""


def by_hand(state, image, heads=2):
    """Patch tokens of a one-block DINOv2, written down from the published description."""
    rows, columns = image.shape[2] // 14, image.shape[3] // 14
    width = state["cls_token"].shape[-1]
    x = f.conv2d(image, state["patch_embed.proj.weight"], state["patch_embed.proj.bias"], stride=14)
    x = torch.cat([state["cls_token"], x.flatten(2).transpose(1, 2)], dim=1)
    registers = "register_tokens" in state
    places = resized_positions(state["pos_embed"][:, 1:], (rows, columns), registers=registers)
    x = x + torch.cat([state["pos_embed"][:, :1], places], dim=1)
    if registers:
        x = torch.cat([x[:, :1], state["register_tokens"], x[:, 1:]], dim=1)

    def norm(x, name):
        return f.layer_norm(x, (width,), state[f"{name}.weight"], state[f"{name}.bias"], eps=1e-6)

    def linear(x, name):
        return f.linear(x, state[f"blocks.0.{name}.weight"], state[f"blocks.0.{name}.bias"])

    q, k, v = linear(norm(x, "blocks.0.norm1"), "attn.qkv").chunk(3, -1)
    q, k, v = (t.reshape(1, -1, heads, width // heads).transpose(1, 2) for t in (q, k, v))
    attention = (q @ k.transpose(-1, -2) / math.sqrt(width // heads)).softmax(-1) @ v
    x = x + state["blocks.0.ls1.gamma"] * linear(attention.transpose(1, 2).reshape(1, -1, width), "attn.proj")
    hidden = f.gelu(linear(norm(x, "blocks.0.norm2"), "mlp.fc1"))
    x = x + state["blocks.0.ls2.gamma"] * linear(hidden, "mlp.fc2")
    tokens = norm(x, "norm")[:, 5 if registers else 1 :]
    return tokens.transpose(1, 2).reshape(1, width, rows, columns)


@pytest.mark.parametrize("registers", [False, True])
def test_official_weights_give_the_published_networks_tokens(registers, official):
    state = official(registers)
    name = "dinov2-s-reg" if registers else "dinov2-s"
    backbone = DinoV2(name, state, (42, 70), **SMALL)
    image = torch.randn((1, 3, 42, 70), generator=torch.Generator().manual_seed(1))
    found = backbone(image)
    assert found.shape == (1, 24, 3, 5)
    assert torch.allclose(found, by_hand(state, image), atol=1e-5)
    assert not any(p.requires_grad for p in backbone.parameters())
    assert backbone.identity != DinoV2(name, official(registers, side=36), (42, 70), **SMALL).identity


def test_the_square_training_grid_keeps_its_position_embedding():
    grid = torch.randn(1, 37**2, 8)
    assert torch.equal(resized_positions(grid, (37, 37), registers=False), grid)
    # A grid that rises evenly from column to column still does so, shifted by half a pixel of either grid.
    ramp = torch.arange(37.0).repeat(37)[None, :, None]
    wide = resized_positions(ramp, (20, 74), registers=True).reshape(20, 74)
    expected = (torch.arange(74) + 0.5) / 2 - 0.5
    assert torch.allclose(wide[10, 4:-4], expected[4:-4], atol=0.02)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda s: s.pop("pos_embed"), "no position embedding"),
        (lambda s: s.pop("norm.weight"), "names or shapes differ"),
        (lambda s: s.update(register_tokens=torch.zeros(1, 4, 24)), "have register tokens"),
    ],
)
def test_weights_of_another_network_are_refused_with_the_official_address(spoil, told, official):
    state = official()
    spoil(state)
    with pytest.raises(ModelError, match=told) as error:
        DinoV2("dinov2-s", state, (42, 70), **SMALL)
    assert "https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth" in str(error.value)


def test_without_weights_and_network_nothing_is_trained(monkeypatch):
    """Random weights would train to something that looks like a result."""
    monkeypatch.setattr("l3ps_trainer.backbones.dinov2.SERVER", "http://127.0.0.1:9")  # where nobody listens
    with pytest.raises(ModelError, match=r"no weights were given.*dinov2_vitb14_reg4_pretrain.pth.*--weights"):
        open_backbone("dinov2-b-reg", None, None, default_size=(448, 798), aspect=1.8)


def test_a_weights_file_that_is_none_is_told_so(tmp_path):
    path = tmp_path / "weights.pth"
    with pytest.raises(ModelError, match="no such file"):
        open_backbone("dinov2-s", path, None, default_size=(448, 798), aspect=1.8)
    path.write_bytes(b"not weights")
    with pytest.raises(ModelError, match="cannot be read"):
        open_backbone("dinov2-s", path, None, default_size=(448, 798), aspect=1.8)


def test_weights_run_no_code(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    torch.save({"cls_token": Trap()}, tmp_path / "weights.pth")
    with pytest.raises(ModelError):
        open_backbone("dinov2-s", tmp_path / "weights.pth", None, default_size=(448, 798), aspect=1.8)
    assert not (tmp_path / "sprung").exists()


def test_an_unknown_backbone_names_the_known():
    with pytest.raises(ModelError, match=r"dinov2-s.*onnx:PATH or scratch"):
        open_backbone("resnet", None, None, default_size=(448, 798), aspect=1.8)


def test_a_size_between_patches_names_the_nearest():
    with pytest.raises(ModelError, match="448x798"):
        DinoV2("dinov2-s", None, (450, 800), **SMALL)


def test_of_several_graphs_the_finest_that_bends_images_little_is_taken(tmp_path, graph):
    for size in ((32, 64), (48, 64), (96, 128), (32, 256)):
        graph(tmp_path / f"{size[1]}x{size[0]}.onnx", size)
    taken = [OnnxGraph(tmp_path, None, aspect=aspect).spec for aspect in (4 / 3, 2.0, 2.1, 6.0, 30.0)]
    assert [(spec.height, spec.width) for spec in taken] == [(96, 128), (96, 128), (32, 64), (32, 256), (32, 256)]
    assert OnnxGraph(tmp_path, (96, 128)).stride == 4
    with pytest.raises(ModelError, match="There are: 96x128, 32x256, 32x64, 48x64"):
        OnnxGraph(tmp_path, (64, 64))


def test_the_normalisation_beside_a_graph_counts(tmp_path, graph):
    graph(tmp_path / "g.onnx", (32, 64))
    assert OnnxGraph(tmp_path / "g.onnx", None).spec.mean == (0.485, 0.456, 0.406)
    (tmp_path / "g.json").write_text('{"mean": [0, 0, 0], "std": [1, 1, 1], "range": "0..255"}')
    assert OnnxGraph(tmp_path / "g.onnx", None).spec.range == "0..255"
    (tmp_path / "g.json").write_text('{"std": [0, 1, 1]}')
    with pytest.raises(ModelError, match=r"g\.json"):
        OnnxGraph(tmp_path / "g.onnx", None)


def test_what_is_no_graph_with_a_feature_map_is_refused(tmp_path):
    with pytest.raises(ModelError, match="no ONNX graph"):
        OnnxGraph(tmp_path, None)
    (tmp_path / "g.onnx").write_bytes(b"\x00nothing")
    with pytest.raises(ModelError, match="no ONNX graph"):
        OnnxGraph(tmp_path / "g.onnx", None)
