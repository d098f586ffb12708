"""A small panoptic network: one encoder, one decoder, two heads.

Residual stages at 1/4, 1/8 and 1/16, a pooled context vector, and a top-down decoder to 1/2 that
narrows where the map is large. Plain 3×3 convolutions
where channels are few, separable ones where they are many: on a CPU that is the faster mix.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as f

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


class PanopticNet(nn.Module):
    """Images to class logits and boundary map, both at the input's resolution.

    Args:
        classes: number of classes of the semantic head.
        width: multiplies every channel count; tests use less than 1.
    """

    def __init__(self, classes: int, width: float = 1.0) -> None:
        super().__init__()
        stem, quarter, eighth, sixteenth, decoder, fine = (
            max(8, int(c * width)) for c in (STEM, QUARTER, EIGHTH, SIXTEENTH, DECODER, FINE)
        )
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
        self.semantic = nn.Conv2d(fine, classes, 1)
        self.boundary = nn.Sequential(nn.Conv2d(fine, 4, 1), nn.PixelShuffle(2))

    def heads(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`forward`, but the logits at half the input's resolution, which is where they are made."""
        half = self.stem(image)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        sixteenth = sixteenth * self.context(sixteenth)
        x = self.laterals[0](sixteenth)
        x = self.smooth[0](_doubled(x) + self.laterals[1](eighth))
        x = self.smooth[1](_doubled(x) + self.laterals[2](quarter))
        x = self.last(_doubled(self.narrow(x)) + self.detail(half))
        return self.semantic(x), torch.sigmoid(self.boundary(x))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Label images.

        Args:
            image: (B, 3, H, W) normalised; H and W multiples of 16.

        Returns:
            (B, C, H, W) class logits and (B, 1, H, W) probability of lying inside a segment.
        """
        semantic, boundary = self.heads(image)
        return _doubled(semantic), boundary
