"""Class probabilities and boundary map as means over tilings of an image (METHOD 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.segment.images import Box

Planes = NDArray[np.float32]
Look = Callable[[Box], tuple[Planes, Planes | None]]
"""One pass over a part of an image: (C, h, w) logits and (h', w') inside of objects, see ``Network.run``."""


def averaged(
    look: Look, size: tuple[int, int], shape: tuple[int, int], semantic: Sequence[int], boundary: Sequence[int]
) -> tuple[Planes, Planes | None]:
    """Means over tilings; a tile that both ask for is looked at once.

    Args:
        look: one pass.
        size: (width, height) of the image.
        shape: rows and columns of the means.
        semantic: tilings for the classes; n stands for n × n tiles.
        boundary: tilings for the boundary map.

    Returns:
        (C, rows, columns) float32 logarithm of the mean probability, whose softmax is that probability, and
        (rows, columns) float32 mean of the boundary map, None where the network has none.
    """
    classes: Planes | None = None
    inside: Planes | None = None
    for tiling in sorted({*semantic, *boundary}):
        for box, window in _tiles(tiling, size, shape):
            logits, boundaries = look(box)
            if tiling in semantic:
                if classes is None:
                    classes = np.zeros((len(logits), *shape), dtype=np.float32)
                for total, part in zip(classes[:, *window], _softmax(logits), strict=True):
                    np.add(total, at_size(part, total.shape), out=total)
            if tiling in boundary and boundaries is not None:
                if inside is None:
                    inside = np.zeros(shape, dtype=np.float32)
                inside[window] += at_size(boundaries, inside[window].shape)
    assert classes is not None
    with np.errstate(divide="ignore"):  # a class that no tile thinks possible
        classes = np.log(classes / len(semantic))
    return classes, None if inside is None else inside / np.float32(len(boundary))


def _tiles(count: int, size: tuple[int, int], shape: tuple[int, int]) -> Iterator[tuple[Box, tuple[slice, slice]]]:
    """Each of count × count tiles in the image and its window in the map; windows cover the map without overlap."""
    x, y = (np.linspace(0, length, count + 1) for length in size)
    rows, columns = (np.linspace(0, length, count + 1).round().astype(int) for length in shape)
    for i in range(count):
        for j in range(count):
            box = (float(x[j]), float(y[i]), float(x[j + 1]), float(y[i + 1]))
            yield box, np.s_[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]


def _softmax(logits: Planes) -> Planes:
    scores = np.exp(logits - logits.max(axis=0))
    return np.asarray(scores / scores.sum(axis=0), dtype=np.float32)


def at_size(plane: Planes, shape: tuple[int, ...]) -> Planes:
    """A map at another resolution; a coarser one is the mean over what its pixels cover."""
    shrinks = shape[0] < plane.shape[0]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(plane, (shape[1], shape[0]), interpolation=interpolation), dtype=np.float32)
