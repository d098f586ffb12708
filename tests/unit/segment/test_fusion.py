"""The fusion looks only where something is; the whole image, looked at plainly, gives the same."""

import cv2
import numpy as np
import pytest

from l3ps.segment.panoptic import fuse
from l3ps.taxonomy import NUSCENES16

CAR, PEDESTRIAN, ROAD = 4, 7, 11


def plainly_fused(semantic, interior, floor):
    """The same rules over the whole image, class by class."""
    semantic, instance, dropped, count = semantic.copy(), np.zeros(semantic.shape, np.int32), semantic < 0, 0
    for thing in sorted(NUSCENES16.things):
        of_class = semantic == thing
        number, labels = cv2.connectedComponents((of_class & interior).astype(np.uint8), connectivity=8)
        if number > 1:
            _, blobs = cv2.connectedComponents(of_class.astype(np.uint8), connectivity=8)
            touched = np.isin(blobs, blobs[labels > 0])
            labels = np.where(of_class & touched, labels[nearest(labels > 0)], 0)
        for label in range(1, number):
            if (labels == label).sum() >= floor:
                count += 1
                instance[labels == label] = count
        dropped |= of_class & (instance == 0)
    if dropped.all():
        return np.zeros_like(semantic), np.zeros_like(instance)
    source = nearest(~dropped)
    return semantic[source], instance[source]


def nearest(mask):
    """Row and column of the nearest True pixel, to every pixel."""
    _, label = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(mask)
    return rows[label - 1], columns[label - 1]


def scene(seed, shape=(90, 160)):
    """Blobs of several classes with ragged edges, specks and a noisy boundary."""
    rng = np.random.default_rng(seed)
    semantic = np.full(shape, ROAD, np.uint8)
    for _ in range(rng.integers(3, 12)):
        x, y, a, b = (int(v) for v in rng.integers((0, 0, 3, 3), (shape[1], shape[0], 30, 30)))
        value = int(rng.choice([2, CAR, 5, PEDESTRIAN]))
        cv2.ellipse(semantic, (x, y), (a, b), float(rng.uniform(0, 180)), 0, 360, value, -1)
    specks = rng.random(shape) < 0.02
    semantic[specks] = rng.choice([0, CAR, PEDESTRIAN, ROAD], int(specks.sum()))
    interior = cv2.GaussianBlur(rng.random(shape), (0, 0), rng.uniform(0.6, 3)) > rng.uniform(0.42, 0.5)
    return semantic, interior


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("cut", [False, True])
def test_only_what_is_there_is_looked_at_and_nothing_else_comes_out(seed, cut):
    semantic, interior = scene(seed)
    floor = [0, 6, 40, 300][seed % 4]
    panoptic = fuse(semantic, (160, 90), interior=interior if cut else None, min_area=floor / semantic.size)
    wanted = plainly_fused(semantic, interior if cut else np.ones_like(interior), floor)
    np.testing.assert_array_equal(panoptic.semantic, wanted[0])
    np.testing.assert_array_equal(panoptic.instance, wanted[1])


@pytest.mark.parametrize("value", [0, ROAD, CAR])
def test_an_image_of_one_class_keeps_it(value):
    semantic = np.full((5, 7), value, np.uint8)
    panoptic = fuse(semantic, (7, 5), interior=np.ones((5, 7), bool))
    assert (panoptic.semantic == value).all()
    assert (panoptic.instance == (value == CAR)).all()


def test_the_input_is_left_as_it_was():
    semantic, interior = scene(1)
    kept = semantic.copy(), interior.copy()
    fuse(semantic, (160, 90), interior=interior, min_area=0.01)
    np.testing.assert_array_equal(semantic, kept[0])
    np.testing.assert_array_equal(interior, kept[1])
