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
        logits: (K, h, w) float32, one plane a class of the network, at every ``step``-th pixel of the label map.
        classes: (K,) uint8 ``NUSCENES16`` class of each plane; several planes may share one.
        step: 1 where there are scores for every pixel; between others they are interpolated.
    """

    logits: NDArray[np.float32]
    classes: NDArray[np.uint8]
    step: int = 1

    @classmethod
    def compact(cls, logits: NDArray[np.float32], classes: NDArray[np.uint8]) -> ClassScores:
        """Scores at no more than about :data:`KEPT_PIXELS`.

        Large maps end in a bilinear enlargement as a rule, which the interpolation makes again.
        """
        step = int(np.ceil(np.sqrt(logits[0].size / KEPT_PIXELS)))
        return cls(logits if step == 1 else logits[:, ::step, ::step].copy(), classes, step)

    def at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float32]:
        """Class probabilities of some pixels.

        Args:
            row, column: (n,) pixel indices in the label map.

        Returns:
            (n, 17) float32 that add up to 1: the softmax over the network's classes, added up over those that share a
            class.
        """
        scores = self.logits[:, row, column] if self.step == 1 else self._between(row, column)
        scores = np.exp(scores - scores.max(axis=0))
        merged = np.zeros((len(NUSCENES16.classes), len(row)), dtype=np.float32)
        for plane, index in zip(scores, self.classes, strict=True):
            merged[index] += plane
        return np.ascontiguousarray((merged / merged.sum(axis=0)).T)

    def _between(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.float32]:
        """(K, n) scores of pixels of the label map, bilinear; beyond the last that was kept, that one."""
        (top, down), (left, right) = (np.divmod(index, self.step) for index in (row, column))
        bottom, far = np.minimum(top + 1, self.logits.shape[1] - 1), np.minimum(left + 1, self.logits.shape[2] - 1)
        down, right = (np.asarray(rest / self.step, dtype=np.float32) for rest in (down, right))
        upper = self.logits[:, top, left] * (1 - right) + self.logits[:, top, far] * right
        lower = self.logits[:, bottom, left] * (1 - right) + self.logits[:, bottom, far] * right
        return np.asarray(upper * (1 - down) + lower * down, dtype=np.float32)


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
