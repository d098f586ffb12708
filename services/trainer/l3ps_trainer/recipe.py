"""Recipes: everything that decides the result besides the images and the backbone. To add one, name it here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Augmentation:
    """How a random view of an image is drawn.

    Attributes:
        crop: least and greatest share of the image's area that a view shows.
        boundary_crop: least share from which a view teaches the boundary head; of views drawn evenly from
            ``crop``, those that count are drawn evenly from this share up, as published.
        stretch: a view's aspect differs from the image's by up to this factor.
        flip: probability of a mirrored view.
        brightness, contrast, saturation: vary by up to this share.
        tint: each of red, green and blue varies by up to this share.
    """

    crop: tuple[float, float] = (0.2, 1.0)
    boundary_crop: float = 0.4
    stretch: float = 1.0
    flip: float = 0.5
    brightness: float = 0.2
    contrast: float = 0.2
    saturation: float = 0.2
    tint: float = 0.0


@dataclass(frozen=True)
class Recipe:
    """How heads are trained.

    Attributes:
        heads: key of :data:`l3ps_trainer.heads.HEADS`.
        size: (height, width) of the network's input where the user and the backbone leave it open.
        epochs: how often every image is seen.
        batch: views a step.
        views: of each image, drawn once and their features kept, then seen in turn; None draws anew each time, which
            costs a pass of the backbone a step.
        least_views: of all images together, for recipes of ``pixels``: the fewer images, the more views of each.
        pixels: of each view, drawn once and kept without the rest of the view, for heads of 1×1 convolutions over a
            frozen backbone; ``batch`` then counts pixels and an epoch sees as many as are kept. None keeps whole views.
        view_size: (height, width) of a training view where it is smaller than the input; only for ``scratch``.
        rate: peak learning rate of Adam.
        warm_up: share of the steps in which the rate rises to its peak, before it falls to 0 along a cosine.
        decay: weight decay, decoupled (AdamW).
        hardest: share of pixels whose cross-entropy counts.
        mine_from: share of the steps over which that share shrinks from all pixels to ``hardest``.
        class_power: of the weights that lift rare classes, see :func:`l3ps_trainer.losses.class_weights`; single
            pixels are drawn by share ** (1 - class_power) of their classes instead.
        boundary_weight: of the boundary loss beside the semantic one.
        boundary_threshold: value of the boundary map under which a pixel separates two segments.
        augmentation: how views are drawn.
    """

    heads: str = "published"
    size: tuple[int, int] = (896, 1596)
    epochs: int = 150
    batch: int = 1
    views: int | None = None
    least_views: int = 0
    pixels: int | None = None
    view_size: tuple[int, int] | None = None
    rate: float = 1e-3
    warm_up: float = 0.0
    decay: float = 0.0
    hardest: float = 0.2
    mine_from: float = 0.0
    class_power: float = 0.0
    boundary_weight: float = 1.0
    boundary_threshold: float = 0.98
    augmentation: Augmentation = field(default_factory=Augmentation)


PUBLISHED = Recipe()
"""As published (METHOD 1); wants a GPU. Both heads learn from one set of features, so a view's crop is shared."""

CPU = Recipe(heads="narrow", size=(448, 798), views=12, boundary_threshold=0.5)
"""The published training on a pool of views: 150 epochs cost twelve backbone passes an image in place of 150."""

FEW_IMAGES = Recipe(
    heads="dropout",
    size=(448, 798),
    epochs=5,
    batch=2048,
    views=1,
    least_views=360,
    pixels=1500,
    rate=2e-3,
    warm_up=0.05,
    decay=1e-2,
    hardest=1.0,
    class_power=0.5,
    boundary_threshold=0.5,
    augmentation=Augmentation(
        crop=(0.3, 1.0), boundary_crop=0.4, stretch=1.25, brightness=0.3, contrast=0.25, saturation=0.4, tint=0.06
    ),
)
"""Pixels of many views through heads that forget half of what they see; chosen by cross-validation inside 30 images."""

SCRATCH = Recipe(
    heads="linear",
    size=(288, 512),
    view_size=(240, 432),
    epochs=220,
    batch=3,
    rate=3e-3,
    warm_up=0.1,
    decay=1e-4,
    hardest=0.5,
    mine_from=0.5,  # mined from the start, a network without pretrained weights learns little
    class_power=0.3,
    boundary_threshold=0.7,
    augmentation=Augmentation(crop=(0.3, 1.0), boundary_crop=0.0, saturation=0.4, tint=0.07),
)
"""A small network trained whole; 220 epochs of 30 images are 2,200 steps."""

RECIPES: dict[str, Recipe] = {"published": PUBLISHED, "cpu": CPU, "few-images": FEW_IMAGES, "scratch": SCRATCH}


def default_recipe(backbone: str, *, cuda: bool) -> Literal["published", "cpu", "few-images", "scratch"]:
    """Name of the recipe for a backbone where the user names none.

    Args:
        backbone: as the user typed it.
        cuda: whether a GPU does the work.
    """
    if backbone == "scratch":
        return "scratch"
    if backbone.startswith("onnx:"):
        return "few-images"
    return "published" if cuda and backbone.startswith("dinov2") else "cpu"
