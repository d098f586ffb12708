"""A few steps on tiny images go all the way to a bundle that the product loads."""

import numpy as np
import pytest
import torch

from l3ps.segment.bundle import ModelBundle
from l3ps.segment.session import Segmenter
from l3ps_trainer.bundle import CLASSES, TOLERANCE, export
from l3ps_trainer.demo_model import worth_annotating
from l3ps_trainer.network import PanopticNet
from l3ps_trainer.samples import Annotated, augmented, inside
from l3ps_trainer.training import Recipe, hard_cross_entropy, intersection_over_union, train

SIZE = (32, 64)
TINY = Recipe(steps=60, batch=2, crop=(32, 48), size=SIZE, rate=1e-2, seed=3)


def halves():
    """An image whose left half is a bright car and whose right half is dark road."""
    rgb = np.full((48, 96, 3), 40, np.uint8)
    rgb[:, :48] = 200
    semantic = np.full((48, 96), 11, np.uint8)
    semantic[:, :48] = 4
    return Annotated(rgb, semantic, (semantic == 4).astype(np.int32))


@pytest.fixture(scope="module")
def network():
    torch.set_num_threads(1)
    return train([halves()] * 2, len(CLASSES), TINY, width=0.25)


def test_a_few_steps_learn_what_brightness_tells(network):
    scores = intersection_over_union(network, [halves()], len(CLASSES), SIZE)
    untrained = intersection_over_union(PanopticNet(len(CLASSES), 0.25).eval(), [halves()], len(CLASSES), SIZE)
    assert np.nanmean(scores) > max(60, np.nanmean(untrained) + 20)
    assert np.isfinite(scores).sum() == 2


def test_the_same_seed_trains_the_same_weights(network):
    again = train([halves()] * 2, len(CLASSES), TINY, width=0.25)
    for one, other in zip(network.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_bundle_gives_what_torch_gives_and_the_product_loads_it(network, tmp_path):
    assert export(network, tmp_path, "tiny", SIZE, 0.5) <= TOLERANCE
    bundle = ModelBundle.load(tmp_path)
    assert bundle.info.lut.tolist() == [*range(17), 0]
    image = Segmenter(bundle, threads=1).segment(halves().rgb)
    assert image.semantic.shape == SIZE
    assert (image.semantic[:, :28] == 4).mean() > 0.8
    assert (image.semantic[:, 36:] == 11).mean() > 0.8
    assert b".py" not in (tmp_path / "model.onnx").read_bytes(), "no trace of the machine it was exported on"


def test_boundary_target_is_zero_beside_another_instance():
    ids = np.zeros((5, 6), np.int32)
    ids[:, 3:] = 7
    assert inside(ids).tolist() == [[1, 1, 0, 0, 1, 1]] * 5


def test_only_the_hardest_labelled_pixels_count():
    logits = torch.zeros(1, 3, 1, 4)
    logits[0, 1] = torch.tensor([9.0, 9.0, -9.0, 0.0])
    classes = torch.tensor([[[1, 1, 1, 0]]])  # two easy, one wrong, one void
    wrong = float(torch.logsumexp(logits[0, :, 0, 2], 0) + 9)
    assert float(hard_cross_entropy(logits, classes, 1 / 3)) == pytest.approx(wrong, rel=1e-5)
    assert float(hard_cross_entropy(logits, classes, 1.0)) == pytest.approx(wrong / 3, rel=1e-2)


def test_views_keep_image_and_truth_together():
    rng = np.random.default_rng(0)
    for _ in range(20):
        view = augmented(halves(), (32, 48), 0.66, rng)
        assert view.rgb.shape == (32, 48, 3)
        bright = view.rgb.mean(axis=2) > view.rgb.mean(axis=2).min() + 40
        if view.semantic.min() == 4 and view.semantic.max() == 11:
            assert (bright == (view.semantic == 4)).mean() > 0.9
        assert ((view.instance > 0) == (view.semantic == 4)).all()


def test_the_pictures_chosen_for_annotation_show_what_is_scarce():
    def plain(label):
        return Annotated(np.zeros((8, 8, 3), np.uint8), np.full((8, 8), label, np.uint8), np.zeros((8, 8), np.int32))

    pictures = [plain(11) for _ in range(9)] + [plain(6)]
    chosen = worth_annotating(pictures, 2)
    assert sorted(int(picture.semantic[0, 0]) for picture in chosen) == [6, 11]
