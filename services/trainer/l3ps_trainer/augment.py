"""Random views of annotated images. A view depends on its random generator alone, so it can be drawn again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .annotations import Annotated
from .losses import inside
from .recipe import Augmentation

Size = tuple[int, int]


@dataclass(frozen=True)
class View:
    """One view of an image.

    Attributes:
        rgb: (H, W, 3) uint8 at the network's input resolution.
        semantic: (h, w) uint8 class at the semantic head's resolution, 0 ignored.
        inside: (h', w') uint8 target of the boundary head at its resolution, or None.
        teaches_boundary: whether the boundary head learns from it.
    """

    rgb: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    inside: NDArray[np.uint8] | None
    teaches_boundary: bool


def draw(
    image: Annotated,
    how: Augmentation,
    rng: np.random.Generator,
    size: Size,
    semantic_size: Size,
    boundary_size: Size | None,
) -> View:
    """A random view: crop, flip, colour.

    Args:
        image: annotated.
        how: how far views vary.
        rng: source of randomness.
        size: (rows, columns) of the picture.
        semantic_size: (rows, columns) of the semantic target.
        boundary_size: (rows, columns) of the boundary target, None where there is no boundary head.
    """
    share = rng.uniform(*how.crop)
    window = _window(image.semantic.shape, share, rng.uniform(-1, 1), how.stretch, rng)
    mirrored = rng.random() < how.flip
    rgb, semantic = _cut(image.rgb, window, mirrored), _cut(image.semantic, window, mirrored)
    border = None
    if boundary_size is not None and image.instance is not None:
        border = inside(_nearest(_cut(image.instance, window, mirrored), boundary_size))
    # Resized as the product resizes (see l3ps.segment.images), so that training sees what inference will see.
    small = np.asarray(Image.fromarray(rgb).resize((size[1], size[0]), Image.Resampling.BILINEAR))
    return View(_recoloured(small, how, rng), _nearest(semantic, semantic_size), border, share >= how.boundary_crop)


def _window(
    shape: tuple[int, ...], share: float, bend: float, stretch: float, rng: np.random.Generator
) -> tuple[slice, slice]:
    """A random window of a share of the area, of the image's aspect up to a factor of ``stretch ** bend``."""
    rows, columns = shape[:2]
    bent = float(np.sqrt(stretch**bend))
    height = min(rows, max(1, round(rows * np.sqrt(share) / bent)))
    width = min(columns, max(1, round(columns * np.sqrt(share) * bent)))
    y, x = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
    return slice(y, y + height), slice(x, x + width)


def _cut(plane: NDArray[Any], window: tuple[slice, slice], mirrored: bool) -> NDArray[Any]:
    cut = plane[window]
    return np.ascontiguousarray(cut[:, ::-1] if mirrored else cut)


def _nearest(plane: NDArray[Any], size: Size) -> NDArray[Any]:
    """Each target pixel takes the label at its centre."""
    return np.asarray(cv2.resize(plane, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT))


def _recoloured(rgb: NDArray[np.uint8], how: Augmentation, rng: np.random.Generator) -> NDArray[np.uint8]:
    image: NDArray[np.float32] = rgb.astype(np.float32)
    grey = image.mean(axis=2, keepdims=True)
    image = grey + (image - grey) * _around_one(how.saturation, rng)
    middle = image.mean()
    image = middle + (image - middle) * _around_one(how.contrast, rng)
    tint = rng.uniform(1 - how.tint, 1 + how.tint, 3).astype(np.float32)
    image = image * (_around_one(how.brightness, rng) * tint)
    return np.asarray(np.clip(image, 0, 255), dtype=np.uint8)


def _around_one(spread: float, rng: np.random.Generator) -> np.float32:
    return np.float32(rng.uniform(1 - spread, 1 + spread))
