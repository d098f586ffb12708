"""What every backbone offers: features of images of one size."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping

from torch import Tensor, nn

from l3ps.segment.bundle import InputSpec

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Backbone(nn.Module, ABC):
    """Images of one fixed size to a feature map.

    Attributes:
        name: as the user asked for it, e.g. ``dinov2-s``.
        channels: D of the feature map.
        stride: pixels of the input that one feature covers in each direction.
        spec: the input: size and normalisation.
        identity: SHA-256 of the weights, or the word ``untrained``; a checkpoint remembers it.
        trainable: whether training changes the weights; else they are frozen and gradients stop at the features.
    """

    name: str
    channels: int
    stride: int
    spec: InputSpec
    identity: str
    trainable: bool = False

    @abstractmethod
    def forward(self, images: Tensor) -> Tensor:
        """Features of images.

        Args:
            images: (B, 3, height, width) float32, normalised as ``spec`` says.

        Returns:
            (B, channels, h, w) float32.
        """

    @abstractmethod
    def at(self, size: tuple[int, int]) -> Backbone:
        """The same network with the same weights for another input.

        Args:
            size: (height, width).

        Raises:
            InputError: the backbone has no such size.
        """

    @abstractmethod
    def check(self, size: tuple[int, int], option: str = "--size") -> None:
        """Refuse an input that :meth:`at` cannot serve.

        Args:
            size: (height, width).
            option: that names it.

        Raises:
            InputError: the backbone has no such size.
        """


def input_spec(size: tuple[int, int]) -> InputSpec:
    """The input of a network trained with ImageNet's mean and deviation.

    Args:
        size: (height, width).
    """
    return InputSpec(name="image", height=size[0], width=size[1], mean=IMAGENET_MEAN, std=IMAGENET_STD)


def digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names and values of weights."""
    found = hashlib.sha256()
    for name, value in sorted(state.items()):
        found.update(name.encode())
        found.update(value.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
