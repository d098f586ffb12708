"""A small encoder and decoder, trained whole: the one backbone that needs no pretrained weights.

Residual stages at 1/4, 1/8 and 1/16, a pooled context vector, and a top-down decoder to 1/2 that
narrows where the map is large. Plain 3×3 convolutions
where channels are few, separable ones where they are many: on a CPU that is the faster mix.
"""

from __future__ import annotations

import copy

from torch import Tensor, nn
from torch.nn import functional as f

from l3ps.errors import ModelError, Problem
from l3ps.segment.bundle import InputSpec

from .base import Backbone

MEAN, STD = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)
"""Normalisation of RGB in 0..1."""
COARSEST = 16
STEM, QUARTER, EIGHTH, SIXTEENTH, DECODER, FINE = 16, 32, 72, 144, 48, 24


def _doubled(x: Tensor) -> Tensor:
    return f.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


class Conv(nn.Sequential):
    """Convolution, normalisation, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Two 3×3 convolutions around an identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            Conv(channels, channels), nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        return f.relu(x + self.body(x))


class Separable(nn.Module):
    """Inverted bottleneck with a dilated depthwise convolution around an identity (MobileNetV2)."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        wide = 2 * channels
        self.body = nn.Sequential(
            Conv(channels, wide, 1),
            nn.Conv2d(wide, wide, 3, padding=dilation, dilation=dilation, groups=wide, bias=False),
            nn.BatchNorm2d(wide),
            nn.ReLU(inplace=True),
            nn.Conv2d(wide, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.body(x)
        return out


class Scratch(Backbone):
    """Images to a narrow feature map at half their size.

    Args:
        size: (height, width) of the input, multiples of 16.
        width: multiplies every channel count; tests use less than 1.

    Raises:
        ModelError: the size is no multiple of 16.
    """

    trainable = True
    name = "scratch"
    identity = "untrained"
    stride = 2

    def __init__(self, size: tuple[int, int], width: float = 1.0) -> None:
        super().__init__()
        self.check(size)
        self.spec = InputSpec(name="image", height=size[0], width=size[1], mean=MEAN, std=STD)
        stem, quarter, eighth, sixteenth, decoder, fine = (
            max(8, int(c * width)) for c in (STEM, QUARTER, EIGHTH, SIXTEENTH, DECODER, FINE)
        )
        self.channels = fine
        self.stem = Conv(3, stem, stride=2)
        self.quarter = nn.Sequential(Conv(stem, quarter, stride=2), Residual(quarter))
        self.eighth = nn.Sequential(Conv(quarter, eighth, stride=2), Residual(eighth), Separable(eighth, 2))
        self.sixteenth = nn.Sequential(
            Conv(eighth, sixteenth, stride=2), *(Separable(sixteenth, d) for d in (1, 2, 4, 1))
        )
        self.context = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(sixteenth, sixteenth, 1), nn.Sigmoid())
        self.laterals = nn.ModuleList(nn.Conv2d(c, decoder, 1) for c in (sixteenth, eighth, quarter))
        self.smooth = nn.ModuleList(Conv(decoder, decoder) for _ in range(2))
        self.narrow = nn.Conv2d(decoder, fine, 1)
        self.detail = nn.Conv2d(stem, fine, 1)
        self.last = Conv(fine, fine)

    def forward(self, images: Tensor) -> Tensor:
        half = self.stem(images)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        sixteenth = sixteenth * self.context(sixteenth)
        x = self.laterals[0](sixteenth)
        x = self.smooth[0](_doubled(x) + self.laterals[1](eighth))
        x = self.smooth[1](_doubled(x) + self.laterals[2](quarter))
        out: Tensor = self.last(_doubled(self.narrow(x)) + self.detail(half))
        return out

    def check(self, size: tuple[int, int], option: str = "--size") -> None:
        """Refuse what is no multiple of 16."""
        if size[0] % COARSEST or size[1] % COARSEST:
            what = f"the encoder halves its input four times, and {size[0]}x{size[1]} is no multiple of {COARSEST}"
            near = "x".join(str(max(1, round(s / COARSEST)) * COARSEST) for s in size)
            raise ModelError(Problem("bad-size", option, what, f"Take {near}."))

    def at(self, size: tuple[int, int]) -> Scratch:
        """The same weights for another input: nothing in it depends on the size."""
        other = copy.copy(self)  # shares the weights
        other.spec = self.spec.model_copy(update={"height": size[0], "width": size[1]})
        return other
