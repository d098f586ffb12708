"""Annotated images so simple that a few steps learn them."""

import numpy as np
import pytest
import torch

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
