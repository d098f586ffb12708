"""Views, targets and losses."""

import numpy as np
import pytest
import torch

from l3ps_trainer.augment import draw
from l3ps_trainer.losses import boundary_loss, class_weights, hard_cross_entropy, inside
from l3ps_trainer.recipe import Augmentation


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


def test_a_view_of_nothing_but_void_teaches_nothing():
    logits = torch.ones(1, 3, 2, 2, requires_grad=True)
    loss = hard_cross_entropy(logits, torch.zeros(1, 2, 2, dtype=torch.int64), 0.2)
    loss.backward()
    assert float(loss.detach()) == 0
    assert not logits.grad.any()


def test_views_of_small_crops_do_not_teach_the_boundary_head():
    logits, target = torch.zeros(2, 1, 2, 2), torch.ones(2, 2, 2)
    logits[1] = 100
    only_first = boundary_loss(logits, target, torch.tensor([True, False]))
    assert float(only_first) == pytest.approx(float(np.log(2)))
    assert float(boundary_loss(logits, target, torch.tensor([False, False]))) == 0


def test_rare_classes_weigh_more_and_none_weigh_equal():
    weights = class_weights(np.array([50, 1000, 100, 10]), 0.3)
    assert weights[3] > weights[2] > weights[1]
    assert class_weights(np.array([50, 1000, 100, 10]), 0) is None


def test_views_keep_image_and_truth_together(image):
    rng = np.random.default_rng(0)
    for _ in range(20):
        view = draw(image, Augmentation(), rng, (32, 48), (32, 48), (16, 24))
        assert view.rgb.shape == (32, 48, 3)
        assert view.inside.shape == (16, 24)
        if view.semantic.min() == 4 and view.semantic.max() == 11:
            bright = view.rgb.mean(axis=2) > (view.rgb.mean(axis=2).min() + view.rgb.mean(axis=2).max()) / 2
            assert (bright == (view.semantic == 4)).mean() > 0.9
            assert not view.inside.all()
        else:
            assert view.inside.all()


def test_a_views_share_of_the_area_decides_whether_it_teaches_the_boundary(image):
    how = Augmentation(crop=(0.2, 1.0), boundary_crop=0.4)
    rng = np.random.default_rng(1)
    teaching = [draw(image, how, rng, (8, 8), (8, 8), (8, 8)).teaches_boundary for _ in range(400)]
    assert np.mean(teaching) == pytest.approx(0.75, abs=0.07)
    assert not draw(image, Augmentation(crop=(0.3, 0.39)), rng, (8, 8), (8, 8), (8, 8)).teaches_boundary


def test_the_same_seed_draws_the_same_view(image):
    one, other = (draw(image, Augmentation(), np.random.default_rng(5), (16, 16), (16, 16), None) for _ in range(2))
    assert (one.rgb == other.rgb).all()
    assert (one.semantic == other.semantic).all()
