"""The authors' checkpoints: files of their keys and shapes become a bundle; whatever is not that is told.

The encoder has the published width and one block in place of twelve, which changes no other key or shape.
"""

from itertools import pairwise

import numpy as np
import onnx
import pytest
import torch
from torch import nn
from torch.nn import functional as f
from typer.testing import CliRunner

from l3ps.errors import ModelError
from l3ps.segment.bundle import ModelBundle
from l3ps_trainer import pastel
from l3ps_trainer.annotations import NUSCENES_AND_SKY
from l3ps_trainer.backbones import DinoV2
from l3ps_trainer.command import app
from l3ps_trainer.runtime import session_of

SIZE = (42, 70)


def head(*widths):
    layers = []
    for a, b in pairwise(widths):
        layers += [nn.Conv2d(a, b, 1), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


@pytest.fixture(scope="module")
def encoder(official):
    return official(width=768)


@pytest.fixture(scope="module")
def heads():
    torch.manual_seed(0)
    return head(768, 300, 300, 200, 18), head(768, 600, 600, 400, 1)


def lightning(path, encoder, head, **more):
    """A checkpoint as Lightning writes it."""
    state = {f"encoder.{name}": value for name, value in encoder.items()}
    state |= {f"head.{name}": value for name, value in head.state_dict().items()}
    torch.save({"epoch": 149, "global_step": 4500, "state_dict": state, "hyper_parameters": {"lr": 1e-3}} | more, path)
    return path


@pytest.fixture
def files(tmp_path, encoder, heads):
    return lightning(tmp_path / "semantic.ckpt", encoder, heads[0]), lightning(tmp_path / "b.ckpt", encoder, heads[1])


@pytest.fixture(autouse=True)
def one_block(monkeypatch):
    whole = pastel.pastel_network
    monkeypatch.setattr(pastel, "pastel_network", lambda *known: whole(*known, depth=1))


def test_both_checkpoints_become_one_graph_with_one_pass_of_the_encoder(files, encoder, heads, tmp_path):
    out = tmp_path / "bundle"
    result = CliRunner().invoke(
        app, ["model", "import-pastel", *map(str, files), "--out", str(out), "--size", "42x70", "--threads", "1"]
    )
    assert result.exit_code == 0, result.stderr
    bundle = ModelBundle.load(out)
    assert bundle.info.classes == NUSCENES_AND_SKY.names
    assert bundle.info.output.boundary_threshold == 0.98
    noise = torch.randn((1, 3, *SIZE), generator=torch.Generator().manual_seed(3))
    session = session_of(out / "model.onnx", threads=1)
    semantic, boundary = session.run(["semantic", "boundary"], {"image": noise.numpy()})
    with torch.no_grad():
        tokens = DinoV2("dinov2-b", encoder, SIZE, depth=1)(noise)
        fine = f.interpolate(tokens, scale_factor=4, mode="bilinear", align_corners=False)
        assert np.allclose(semantic, heads[0](fine).numpy(), atol=1e-4)
        assert np.allclose(boundary, torch.sigmoid(heads[1](fine)).numpy(), atol=1e-4)
    kinds = [node.op_type for node in onnx.load_from_string(bundle.graph).graph.node]
    assert kinds.count("LayerNormalization") == 3, "two of the one block and the last one, not two encoders"


def refused(semantic, boundary):
    with pytest.raises(ModelError) as error:
        pastel.pastel_network(semantic, boundary, NUSCENES_AND_SKY, SIZE)
    return str(error.value)


def test_heads_of_different_encoders_are_refused(files, encoder, heads, tmp_path):
    other = encoder | {"norm.bias": encoder["norm.bias"] + 1}
    told = refused(files[0], lightning(tmp_path / "other.ckpt", other, heads[1]))
    assert "1 tensors differ, norm.bias first" in told


def test_another_number_of_classes_is_told(files, encoder, tmp_path):
    wrong = lightning(tmp_path / "w.ckpt", encoder, head(768, 300, 300, 200, 20))
    assert "ends in 20 channels where 18 classes" in refused(wrong, files[1])


def test_swapped_files_are_told(files):
    assert "ends in 1 channels where 18 classes" in refused(files[1], files[0])


def test_a_head_that_is_no_sequence_of_pointwise_convolutions_is_told(files, encoder, tmp_path):
    wide = nn.Sequential(nn.Conv2d(768, 8, 3), nn.ReLU(), nn.Conv2d(8, 18, 1))
    assert "8×768×3×3" in refused(lightning(tmp_path / "w.ckpt", encoder, wide), files[1])
    fewer = nn.Sequential(nn.Conv2d(768, 18, 1))
    assert "no sequence" in refused(lightning(tmp_path / "v.ckpt", encoder, fewer), files[1])


def test_missing_and_foreign_keys_are_told(files, encoder, heads, tmp_path):
    assert "no key of its state_dict begins with 'head.'" in refused(
        lightning(tmp_path / "w.ckpt", encoder, nn.Sequential()), files[1]
    )
    torch.save({"weights": {}}, tmp_path / "v.ckpt")
    assert "no state_dict" in refused(tmp_path / "v.ckpt", files[1])
    lacking = {name: value for name, value in encoder.items() if name != "norm.bias"}
    same = (lightning(tmp_path / f"{i}.ckpt", lacking, heads[i]) for i in range(2))
    assert "names or shapes differ" in refused(*same)


def test_no_file_and_half_a_file_are_told(files, tmp_path):
    assert "no such file" in refused(tmp_path / "none.ckpt", files[1])
    (tmp_path / "half.ckpt").write_bytes(files[0].read_bytes()[:100_000])
    assert "cut short" in refused(tmp_path / "half.ckpt", files[1])


def test_a_checkpoint_runs_no_code(files, encoder, heads, tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    trapped = lightning(tmp_path / "t.ckpt", encoder, heads[0], callbacks=Trap())
    assert "could run its code" in refused(trapped, files[1])
    assert not (tmp_path / "sprung").exists()
