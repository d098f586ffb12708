"""Class scores of an image: the arg max that labels it, and what is kept of them for the refinement."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.taxonomy import NUSCENES16

KEPT_PIXELS = 1 << 18
"""Above so many pixels scores are kept at a fraction of the resolution. A scan has 3,000 to 5,000 points in an image;
the 20 planes of 512 × 1024 that a network for street scenes returns take 42 MB, a quarter of them 10 MB."""


@dataclass(frozen=True, slots=True)
class ClassScores:
    """The network's raw scores, made probabilities only where a point asks.

    A scan's points meet one pixel in fifty: a softmax over the whole picture would cost as much as a tenth of the
    network and 17 planes of memory.

    Attributes:
        logits: (K, h, w) float32, one plane a class of the network.
        classes: (K,) uint8 ``NUSCENES16`` class of each plane; several planes may share one.
        shape: rows and columns of the label map that the scores belong to, where it is finer or coarser than they
            are; None where it is not.
    """

    logits: NDArray[np.float32]
    classes: NDArray[np.uint8]
    shape: tuple[int, int] | None = None

    @classmethod
    def compact(cls, logits: NDArray[np.float32], classes: NDArray[np.uint8], shape: tuple[int, int]) -> ClassScores:
        """Scores at no more than :data:`KEPT_PIXELS`, each the mean of the block of pixels it stands for."""
        height, width = logits.shape[1:]
        factor = int(np.ceil(np.sqrt(height * width / KEPT_PIXELS)))
        if factor > 1:
            size = (-(-width // factor), -(-height // factor))
            logits = np.stack([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in logits])
        return cls(logits, classes, shape)

    def at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float32]:
        """Class probabilities of some pixels.

        Args:
            row, column: (n,) pixel indices in the label map.

        Returns:
            (n, 17) float32 that add up to 1: the softmax over the network's classes, added up over those that share a
            class.
        """
        if self.shape is not None:
            row, column = (
                (2 * index + 1) * kept // (2 * of)  # the pixel in which the centre of the label map's pixel lies
                for index, kept, of in zip((row, column), self.logits.shape[1:], self.shape, strict=True)
            )
        scores = self.logits[:, row, column]
        scores = np.exp(scores - scores.max(axis=0))
        merged = np.zeros((len(NUSCENES16.classes), len(row)), dtype=np.float32)
        for plane, index in zip(scores, self.classes, strict=True):
            merged[index] += plane
        return np.ascontiguousarray((merged / merged.sum(axis=0)).T)


def strongest(logits: NDArray[np.float32]) -> NDArray[np.int32]:
    """Index of the highest of K planes at each pixel, the first of equal ones.

    Over 20 planes of 512 × 1024 OpenCV takes 6 to 10 ms and numpy's ``argmax`` over the first axis 16.

    Args:
        logits: (K, h, w) float32.

    Returns:
        (h, w) int32.
    """
    flat = logits.reshape(len(logits), -1)  # three axes OpenCV may take for rows, columns and channels
    return np.asarray(cv2.reduceArgMax(flat, 0), dtype=np.int32).reshape(logits.shape[1:])
