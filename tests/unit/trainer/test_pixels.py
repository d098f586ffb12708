"""Pixels of many views as batches: what is drawn, what is kept, and a whole training on them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional as f

from l3ps.errors import Cancelled
from l3ps.segment.images import network_input
from l3ps_trainer import checkpoint
from l3ps_trainer.annotations import NUSCENES_AND_SKY, Annotated, AnnotationSet
from l3ps_trainer.backbones import OnnxGraph
from l3ps_trainer.heads import HEADS
from l3ps_trainer.pixels import PixelPool, between, drawn
from l3ps_trainer.recipe import FEW_IMAGES, Augmentation, default_recipe
from l3ps_trainer.reporting import silent
from l3ps_trainer.training import train
from l3ps_trainer.validation import Confusion
from l3ps_trainer.views import Views

SHORT = replace(FEW_IMAGES, least_views=12, pixels=40, batch=64, epochs=8, rate=1e-2)
"""60 steps."""


@pytest.fixture
def pooled(tmp_path, graph):
    """Makes a filled pool of some images, with boundary targets."""

    def fill(images, recipe=SHORT):
        backbone = OnnxGraph(graph(tmp_path / "g.onnx", (32, 64)), None)
        known = AnnotationSet.of(NUSCENES_AND_SKY, images)
        pool = PixelPool(Views(known, backbone.spec, recipe, ((32, 64), (8, 16)), 0), tmp_path, backbone.channels)
        pool.fill(backbone, torch.device("cpu"), silent)
        return pool

    return fill


def test_chances_decide_which_pixels_are_drawn():
    chances = np.zeros((2, 4))
    chances[0, 3], chances[1, 1] = 3, 1
    places = drawn(chances, 4000, np.random.default_rng(0))
    assert set(map(tuple, places)) == {(0.25, 0.875), (0.75, 0.375)}
    assert (places[:, 0] == 0.25).mean() == pytest.approx(0.75, abs=0.03)


def test_a_view_of_nothing_but_void_still_gives_pixels():
    assert len(np.unique(drawn(np.zeros((2, 4)), 400, np.random.default_rng(0)), axis=0)) == 8


def test_a_feature_between_cells_is_that_of_the_enlarged_map():
    features = torch.randn(3, 4, 6)
    large = f.interpolate(features[None], scale_factor=5, mode="bilinear", align_corners=False)[0]
    pixels = ((0, 0), (7, 11), (19, 29))
    places = np.array([[(y + 0.5) / 20, (x + 0.5) / 30] for y, x in pixels])
    assert torch.allclose(between(features, places).T, torch.stack([large[:, y, x] for y, x in pixels]), atol=1e-5)


def test_fewer_images_give_more_views_of_each_and_as_many_steps(pooled, image):
    one, three = pooled([image]), pooled([image] * 3)
    assert (one.each, three.each) == (12, 4)
    assert one.steps == three.steps == 8 * 12 * 40 / 64


def test_a_pixels_feature_and_truth_belong_together(pooled, image):
    batch = next(iter(pooled([image]).batches(0, 1)))
    assert batch.inputs.shape == (64, 8, 1, 1)
    assert batch.semantic.shape == batch.inside.shape == (64, 1, 1)
    response = batch.inputs[:, 0, 0, 0].sign()  # of a convolution: linear in brightness, which is normalised around 0
    car, road = (response[batch.semantic[:, 0, 0] == label] for label in (4, 11))
    assert abs(float(car.mean())) > 0.8
    assert float(car.mean()) * float(road.mean()) < -0.6


def test_rare_classes_are_drawn_more_often_than_they_occur(pooled):
    semantic = np.full((40, 80), 11, np.uint8)
    semantic[:4, :8] = 7  # 1 %
    semantic[36:] = 0
    image = Annotated(np.full((40, 80, 3), 90, np.uint8), semantic, np.zeros((40, 80), np.int32))
    pool = pooled([image], replace(SHORT, augmentation=Augmentation(crop=(1.0, 1.0))))
    found = torch.cat([batch.semantic.flatten() for batch in pool.batches(0, 8)])
    assert float((found == 7).float().mean()) == pytest.approx(0.1, abs=0.04), "sqrt(1) of sqrt(1) + sqrt(89) ≈ 10 %"
    assert not (found == 0).any(), "void teaches nothing"


def test_a_stopped_training_ends_with_the_same_weights_and_knows_the_classes(tmp_path, graph, known, unseen):
    backbone = OnnxGraph(graph(tmp_path / "g.onnx", (32, 64)), None)

    def trained(folder, report=silent):
        folder.mkdir(exist_ok=True)
        torch.manual_seed(0)
        heads = HEADS["dropout"](backbone.channels, len(known.classes), boundary=True, stride=backbone.stride)
        train(backbone, heads, known, SHORT, folder, {}, report=report)
        return heads

    def stop(step, done, total, **figures):
        if (step, done) == ("train", 20):
            raise Cancelled

    whole = trained(tmp_path / "one")
    with pytest.raises(Cancelled):
        trained(tmp_path / "two", stop)
    resumed = trained(tmp_path / "two").state_dict()
    assert all(torch.equal(value, resumed[name]) for name, value in whole.state_dict().items())
    confusion, image = Confusion(len(known.classes)), unseen.images[0].load()
    with torch.no_grad():
        semantic, _ = whole(backbone(torch.from_numpy(network_input(Image.fromarray(image.rgb), backbone.spec))))
    confusion.add(image.semantic, semantic[0, 1:].numpy())
    assert confusion.miou() > 90
    assert {path.name for path in (tmp_path / "two").iterdir()} == {checkpoint.NAME}, "kept pixels are freed"


def test_graphs_are_taught_by_few_images_unless_told_otherwise():
    assert default_recipe("onnx:any", cuda=False) == default_recipe("onnx:any", cuda=True) == "few-images"
