"""Heads over a feature map, by name: class logits, and the logit of lying inside a segment.

A pair of heads is a module that takes (B, D, h, w) features and returns semantic logits (B, C, h', w') and, where
annotations have instances, boundary logits (B, 1, h'', w'') at resolutions of its own. To add one, write it and name it
in :data:`HEADS`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as f


class Pointwise(nn.Module):
    """1×1 convolutions on bilinearly enlarged features, ReLU between them.

    The first convolution works before the enlarging: both are linear, one over channels, the other over pixels with
    weights that add up to 1, so they commute exactly, and the first then costs 1 / enlargement² of it.

    Args:
        channels: of the features.
        widths: channels between the layers.
        outputs: channels at the end.
        enlargement: how much finer than the features the result is.
        exported: as ``enlargement``, in the bundle; the same where None.
    """

    def __init__(
        self, channels: int, widths: Sequence[int], outputs: int, enlargement: int, exported: int | None = None
    ) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in pairwise((channels, *widths, outputs)))
        self.enlargement, self.exported = enlargement, exported or enlargement

    def forward(self, features: Tensor) -> Tensor:
        x: Tensor = self.layers[0](features)
        if self.enlargement > 1:
            x = f.interpolate(x, scale_factor=float(self.enlargement), mode="bilinear", align_corners=False)
        for layer in self.layers[1:]:
            x = layer(f.relu(x))
        return x


class Dropping(nn.Sequential):
    """1×1 convolutions at the features' own resolution, normalised over the batch, with much dropout between.

    With few images the danger is a head that knows them by heart: dropping 40 % of the features and half of what is
    made of them was worth 1.5 mIoU in one fold of cross-validation on 30 images. In the exported graph both are gone.

    Args:
        channels: of the features.
        widths: channels between the layers.
        outputs: channels at the end.
    """

    def __init__(self, channels: int, widths: Sequence[int], outputs: int) -> None:
        layers: list[nn.Module] = [nn.Dropout(DROPPED_FEATURES)]
        for before, after in pairwise((channels, *widths)):
            convolution = nn.Conv2d(before, after, 1, bias=False)
            layers += [convolution, nn.BatchNorm2d(after), nn.ReLU(), nn.Dropout(DROPPED_INSIDE)]
        super().__init__(*layers, nn.Conv2d(widths[-1], outputs, 1))


DROPPED_FEATURES, DROPPED_INSIDE = 0.4, 0.5


class Heads(nn.Module):
    """A semantic and, where wanted, a boundary head on the same features."""

    def __init__(self, semantic: nn.Module, boundary: nn.Module | None) -> None:
        super().__init__()
        self.semantic, self.boundary = semantic, boundary

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor | None]:
        return self.semantic(features), self.boundary(features) if self.boundary is not None else None

    def for_export(self) -> Heads:
        """The heads as the bundle carries them.

        A pointwise head is a function of the enlarged features at a pixel, so a coarser grid only samples its logits
        more sparsely; what is finer is interpolated where it is needed. At 14× the published semantic head would cost
        a CPU a fifth of a ViT-B.
        """
        heads = copy.deepcopy(self)
        for module in heads.modules():
            if isinstance(module, Pointwise):
                module.enlargement = module.exported
        return heads


def quarter(stride: int) -> int:
    """Enlargement that makes features about a quarter of the input's size, 4 for those of a ViT/14."""
    return max(1, round(stride / 4 + 0.01))


def published(channels: int, classes: int, *, boundary: bool, stride: int) -> Heads:
    """Heads of the published widths and resolutions (METHOD 1, with DINOv2 ViT-B/14)."""
    return Heads(
        Pointwise(channels, (300, 300, 200), classes, stride, quarter(stride)),
        Pointwise(channels, (600, 600, 400), 1, quarter(stride)) if boundary else None,
    )


def narrow(channels: int, classes: int, *, boundary: bool, stride: int) -> Heads:
    """Lighter heads that cost a ViT-S/14 under 5 % of its own work."""
    return Heads(
        Pointwise(channels, (300, 200), classes, quarter(stride)),
        Pointwise(channels, (200, 100), 1, quarter(stride)) if boundary else None,
    )


def dropout(channels: int, classes: int, *, boundary: bool, stride: int) -> Heads:
    """Heads for few images over features as fine as a result needs to be, see :class:`Dropping`."""
    return Heads(
        Dropping(channels, (128, 64), classes),
        Dropping(channels, (64, 32), 1) if boundary else None,
    )


class _PixelLogit(nn.Sequential):
    """One logit a pixel at twice the features' resolution."""

    def __init__(self, channels: int) -> None:
        super().__init__(nn.Conv2d(channels, 4, 1), nn.PixelShuffle(2))


def linear(channels: int, classes: int, *, boundary: bool, stride: int) -> Heads:
    """One convolution each, for features that were trained with it."""
    return Heads(nn.Conv2d(channels, classes, 1), _PixelLogit(channels) if boundary else None)


HEADS: dict[str, Callable[..., Heads]] = {
    "published": published,
    "narrow": narrow,
    "dropout": dropout,
    "linear": linear,
}
"""Name → maker of heads, called with the features' channels, the number of classes, whether there is a boundary head,
and how many pixels of the input one feature covers (``stride``)."""


def output_sizes(heads: Heads, channels: int, grid: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int] | None]:
    """Resolutions at which heads answer.

    Args:
        heads: the heads.
        channels: of the features.
        grid: (h, w) of the features.

    Returns:
        (rows, columns) of the semantic logits and of the boundary logits, None where there is no boundary head.
    """
    with torch.no_grad():  # on the meta device nothing is computed but shapes
        semantic, boundary = copy.deepcopy(heads).to("meta")(torch.empty((1, channels, *grid), device="meta"))
    return tuple(semantic.shape[-2:]), None if boundary is None else tuple(boundary.shape[-2:])
