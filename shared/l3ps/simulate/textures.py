"""Tileable noise: the raw material of asphalt, plaster, leaves and clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

SIZE = 512
"""Edge of every noise tile in texels; a power of two so that wrapping is one bitwise and."""


def tile(rng: np.random.Generator, exponent: float) -> Array:
    """A tileable noise image with a power-law spectrum.

    Args:
        rng: source of the phases.
        exponent: fall of the amplitude with frequency; 0 is white noise, 1.5 looks like clouds.

    Returns:
        (SIZE, SIZE) float32, mean 0, standard deviation 1, clipped to ±2.5.
    """
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None, :]) * SIZE
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / frequency**exponent
    spectrum[0, 0] = 0.0
    image = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.asarray(np.clip(image / image.std(), -2.5, 2.5), dtype=np.float32)


@dataclass(frozen=True)
class NoiseTiles:
    """The three grains every surface of a world is made from.

    Attributes:
        fine: nearly white, for grain and grit.
        medium: blotches, for leaves, plaster and grass.
        coarse: cloudy, for stains, patches and the sky.
    """

    fine: Array
    medium: Array
    coarse: Array

    @classmethod
    def make(cls, rng: np.random.Generator) -> NoiseTiles:
        """Three independent tiles."""
        return cls(fine=tile(rng, 0.3), medium=tile(rng, 0.9), coarse=tile(rng, 1.5))


def sample(texture: Array, u: Array, v: Array, per_metre: float) -> Array:
    """Nearest texel at surface coordinates, wrapping in both directions.

    Args:
        texture: a noise tile.
        u, v: (n,) coordinates in metres.
        per_metre: texels a metre.

    Returns:
        (n,) float32.
    """
    column = (u * np.float32(per_metre)).astype(np.int32) & (SIZE - 1)
    row = (v * np.float32(per_metre)).astype(np.int32) & (SIZE - 1)
    return np.asarray(texture[row, column])


def cell_hash(u: NDArray[np.int32], v: NDArray[np.int32], salt: Array | float) -> Array:
    """A repeatable pseudo-random number in 0..1 for each integer cell, e.g. each window of a façade.

    Args:
        u, v: (n,) integer cell coordinates.
        salt: decorrelates objects; a number or (n,).

    Returns:
        (n,) float32.
    """
    mixed = np.sin(u * np.float32(12.9898) + v * np.float32(78.233) + np.float32(37.719) * salt) * np.float32(4375.85)
    return np.asarray(mixed - np.floor(mixed), dtype=np.float32)
