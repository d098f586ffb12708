"""The ways to look at an image, on networks whose answers are known."""

import json

import numpy as np
import pytest

from l3ps.errors import ModelError
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.presets import BALANCED, FAST, PAPER, SegmentPreset
from l3ps.segment.scores import KEPT_PIXELS, ClassScores, strongest
from l3ps.segment.session import Segmenter
from l3ps.segment.tiles import averaged

CAR, VEGETATION, ROAD = 4, 16, 11


def test_every_tile_is_looked_at_once_and_lands_in_its_place():
    """Each pass says class 1 for the tile at the lower right of its tiling, class 0 elsewhere."""
    looked = []

    def look(box):
        looked.append(box)
        corner = box[2:] == (60, 30)
        return np.array([0, 50 if corner else -50], np.float32).reshape(2, 1, 1) + np.zeros((2, 4, 8), np.float32), None

    scores, inside = averaged(look, (60, 30), (12, 24), semantic=(1, 2, 3), boundary=(3,))
    assert len(looked) == len(set(looked)) == 1 + 4 + 9
    assert looked[1:5] == [(0, 0, 30, 15), (30, 0, 60, 15), (0, 15, 30, 30), (30, 15, 60, 30)]
    expected = np.full((12, 24), 1 / 3)
    expected[6:, 12:] = 2 / 3
    expected[8:, 16:] = 1
    np.testing.assert_allclose(np.exp(scores[1]), expected, atol=1e-6)
    np.testing.assert_allclose(np.exp(scores).sum(axis=0), 1, atol=1e-6)
    assert inside is None


def test_the_boundary_map_is_the_mean_over_its_own_tilings():
    sides = []

    def look(box):
        sides.append(round(60 / (box[2] - box[0])))
        return np.zeros((2, 4, 8), np.float32), np.full((5, 9), float(sides[-1] == 4), np.float32)

    _, inside = averaged(look, (60, 30), (13, 25), semantic=(1,), boundary=(3, 4))
    assert sorted(set(sides)) == [1, 3, 4] and len(sides) == 1 + 9 + 16
    np.testing.assert_allclose(inside, 0.5, err_msg="tiles cover every pixel once, whatever the rounding")


def painted():
    """A car on the left, one pixel column of vegetation that only a closer look resolves, road elsewhere."""
    image = np.zeros((64, 128, 3), np.uint8)
    image[..., 2] = 255
    image[16:48, 16:48] = (255, 0, 0)
    image[:, 100] = (0, 255, 0)
    return image


def test_tilings_agree_with_one_pass_where_there_is_nothing_more_to_see(write_bundle):
    bundle = ModelBundle.load(write_bundle())
    fast = Segmenter(bundle, preset=FAST).segment(painted())
    tiled = Segmenter(bundle, preset=SegmentPreset("paper", (1, 2, 3), (3, 4))).segment(painted())
    assert tiled.semantic.shape == fast.semantic.shape == (32, 64)
    assert (tiled.semantic[:, :45] == fast.semantic[:, :45]).all()
    assert set(np.unique(tiled.instance)) == {0, 1}
    rows, columns = np.array([16, 1]), np.array([16, 60])
    np.testing.assert_allclose(tiled.scores.at(rows, columns).sum(axis=1), 1, atol=1e-5)
    assert tiled.scores.at(rows, columns).argmax(axis=1).tolist() == [CAR, ROAD]


def test_passes_are_counted_once_for_both_heads():
    assert FAST.passes(boundary=True) == BALANCED.passes(boundary=False) == 1
    assert PAPER.passes(boundary=False) == 14
    assert PAPER.passes(boundary=True) == 30


def test_balanced_runs_the_larger_graph_of_the_bundle(write_bundle):
    passes = {"balanced": {"graph": "model-balanced.onnx", "height": 64, "width": 128}}
    folder = write_bundle(info=write_bundle.description(passes=passes))
    (folder / "model-balanced.onnx").write_bytes(write_bundle.graph(height=64, width=128))
    image = painted()
    bundle = ModelBundle.load(folder)
    assert Segmenter(bundle, preset=BALANCED).segment(image).semantic.shape == (64, 128)
    assert Segmenter(bundle, preset=BALANCED).segment(image).semantic[5, 100] == VEGETATION
    assert Segmenter(bundle, preset=FAST).segment(image).semantic.shape == (32, 64)


def test_a_bundle_without_that_graph_is_refused_with_the_remedy(write_bundle):
    with pytest.raises(ModelError, match=r"no graph for the preset 'balanced'.*--balanced"):
        Segmenter(ModelBundle.load(write_bundle()), preset=BALANCED)


def test_the_strongest_class_is_that_of_argmax_and_the_first_of_equal_ones():
    rng = np.random.default_rng(0)
    for shape in ((3, 32, 64), (1, 4, 5), (40, 1, 7), (20, 130, 600)):
        logits = rng.integers(0, 9, shape).astype(np.float32)
        np.testing.assert_array_equal(strongest(logits), logits.argmax(axis=0))


def test_large_scores_are_kept_small_and_found_by_the_label_map_s_pixels():
    shape = (600, 1000)
    logits = np.zeros((2, *shape), np.float32)
    logits[1, 300:, 500:] = 50
    logits[0, :300, :500] = 50
    kept = ClassScores.compact(logits, np.array([CAR, ROAD], np.uint8), shape)
    assert kept.logits[0].size <= KEPT_PIXELS
    row, column = np.array([0, 290, 310, 599, 0]), np.array([0, 490, 510, 999, 999])
    assert kept.at(row, column)[:, CAR].round(3).tolist() == [1, 1, 0, 0, 0.5]


def test_small_scores_are_kept_as_they_are():
    logits = np.random.default_rng(0).normal(size=(3, 40, 60)).astype(np.float32)
    kept = ClassScores.compact(logits, np.array([CAR, ROAD, ROAD], np.uint8), (40, 60))
    assert kept.logits is logits
    row, column = np.divmod(np.arange(2400), 60)
    expected = np.exp(logits) / np.exp(logits).sum(axis=0)
    np.testing.assert_allclose(kept.at(row, column)[:, CAR], expected[0].ravel(), rtol=1e-5)


def test_the_command_offers_the_ways(small_drive, write_bundle, tmp_path):
    from typer.testing import CliRunner

    from l3ps_cli.main import app

    bundle = write_bundle()

    def label(*options):
        words = ["label", small_drive, "--model", bundle, "--out", tmp_path / "o", *options]
        return CliRunner().invoke(app, [str(word) for word in words])

    refused = label("--segment", "balanced")
    assert refused.exit_code == 2
    assert "no graph for the preset 'balanced'" in " ".join(refused.stderr.split())
    assert not (tmp_path / "o").exists()
    unknown = label("--segment", "closer")
    assert unknown.exit_code == 2 and "there is no 'closer'" in unknown.stderr
    report = tmp_path / "run.json"
    assert label("--segment", "paper", "--report", report).exit_code == 0
    assert json.loads(report.read_text())["segment"] == {**PAPER.as_dict(), "semantic": [1, 2, 3], "boundary": [3, 4]}
