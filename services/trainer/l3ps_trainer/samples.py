"""Annotated images as training samples: augmentation and targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MEAN, STD = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)
"""Normalisation of RGB in 0..1."""
IGNORED = 0
"""Void: no loss, no score."""


@dataclass(frozen=True)
class Annotated:
    """One annotated image.

    Attributes:
        rgb: (H, W, 3) uint8.
        semantic: (H, W) uint8 class, 0 ignored.
        instance: (H, W) int32 segment id, 0 for stuff.
    """

    rgb: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]


def inside(instance: NDArray[np.int32]) -> NDArray[np.float32]:
    """Boundary target: 0 where a neighbour within 1.5 px has another instance id, else 1.

    Args:
        instance: (H, W) ids.

    Returns:
        (H, W) float32.
    """
    kernel = np.ones((3, 3), np.uint8)  # the neighbours within 1.5 px
    ids = instance.astype(np.float32)  # exact up to 2²⁴ ids
    border = cv2.BORDER_REPLICATE
    high, low = (cv2.morphologyEx(ids, op, kernel, borderType=border) for op in (cv2.MORPH_DILATE, cv2.MORPH_ERODE))
    return np.asarray(high == low, dtype=np.float32)


def normalised(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(3, H, W) float32 network input of an (H, W, 3) uint8 image."""
    mean, std = np.asarray(MEAN, np.float32), np.asarray(STD, np.float32)
    scaled = (rgb.astype(np.float32) / 255 - mean) / std
    return np.ascontiguousarray(scaled.transpose(2, 0, 1))


def augmented(sample: Annotated, crop: tuple[int, int], unit: float, rng: np.random.Generator) -> Annotated:
    """A random view: flip, scale, crop, colour.

    Args:
        sample: the annotated image.
        crop: (height, width) of the view.
        unit: scale at which the network later sees whole images; views vary around it.
        rng: source of randomness.
    """
    height, width = crop
    rows, columns = sample.semantic.shape
    least = max(height / rows, width / columns)
    scale = max(least, unit * float(np.exp(rng.uniform(np.log(0.85), np.log(1.5)))))
    size = (max(width, round(columns * scale)), max(height, round(rows * scale)))
    x, y = int(rng.integers(size[0] - width + 1)), int(rng.integers(size[1] - height + 1))
    window = np.s_[y : y + height, x : x + width]
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    rgb = cv2.resize(sample.rgb, size, interpolation=shrink)[window]
    semantic = cv2.resize(sample.semantic, size, interpolation=cv2.INTER_NEAREST)[window]
    instance = cv2.resize(sample.instance, size, interpolation=cv2.INTER_NEAREST)[window]
    if rng.random() < 0.5:
        rgb, semantic, instance = rgb[:, ::-1], semantic[:, ::-1], instance[:, ::-1]
    return Annotated(_jittered(rgb, rng), np.asarray(semantic, np.uint8), np.asarray(instance, np.int32))


def _jittered(rgb: NDArray[Any], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Brightness, contrast, saturation and tint by up to about 20 %."""
    image: NDArray[np.float32] = rgb.astype(np.float32)
    grey = image.mean(axis=2, keepdims=True)
    image = grey + (image - grey) * np.float32(rng.uniform(0.6, 1.4))
    middle = image.mean()
    image = middle + (image - middle) * np.float32(rng.uniform(0.8, 1.2))
    image = image * (rng.uniform(0.8, 1.2) * rng.uniform(0.93, 1.07, 3)).astype(np.float32)
    return np.asarray(np.clip(image, 0, 255), dtype=np.uint8)


def batch(samples: list[Annotated]) -> tuple[Tensor, Tensor, Tensor]:
    """Stack samples of one size: images (B, 3, H, W), classes (B, H, W) int64, boundary targets (B, H, W)."""
    images = torch.from_numpy(np.stack([normalised(s.rgb) for s in samples]))
    classes = torch.from_numpy(np.stack([s.semantic.astype(np.int64) for s in samples]))
    edges = torch.from_numpy(np.stack([inside(np.ascontiguousarray(s.instance)) for s in samples]))
    return images, classes, edges
