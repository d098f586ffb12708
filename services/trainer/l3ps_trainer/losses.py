"""Losses of the two heads (METHOD 1)."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as f

from .annotations import IGNORED


def hard_cross_entropy(logits: Tensor, classes: Tensor, share: float, weights: Tensor | None = None) -> Tensor:
    """Mean cross-entropy over the hardest share of all labelled pixels of the batch.

    Args:
        logits: (B, C, H, W).
        classes: (B, H, W) int64, 0 ignored.
        share: 0..1.
        weights: (C,) of the classes, or None for equal ones.
    """
    loss = f.cross_entropy(logits, classes, weights, ignore_index=IGNORED, reduction="none")[classes != IGNORED]
    if loss.numel() == 0:  # a view of nothing but void teaches nothing
        return logits.sum() * 0
    return loss.topk(max(1, int(share * loss.numel()))).values.mean()


def boundary_loss(logits: Tensor, inside: Tensor, counts: Tensor) -> Tensor:
    """Binary cross-entropy of lying inside a segment.

    Args:
        logits: (B, 1, H, W).
        inside: (B, H, W) target, 0 on the line between two segments, else 1.
        counts: (B,) bool, False for views that do not teach this head.
    """
    if not bool(counts.any()):
        return logits.sum() * 0
    return f.binary_cross_entropy_with_logits(logits[counts, 0], inside[counts])


def inside(instance: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Boundary target: 0 where a neighbour within 1.5 px has another instance id, else 1.

    Args:
        instance: (H, W) ids.

    Returns:
        (H, W) uint8.
    """
    kernel = np.ones((3, 3), np.uint8)  # the neighbours within 1.5 px
    ids = instance.astype(np.float32)  # exact up to 2²⁴ ids
    border = cv2.BORDER_REPLICATE
    high, low = (cv2.morphologyEx(ids, op, kernel, borderType=border) for op in (cv2.MORPH_DILATE, cv2.MORPH_ERODE))
    return np.asarray(high == low, dtype=np.uint8)


def class_weights(pixels: NDArray[np.int64], power: float) -> Tensor | None:
    """(C,) weights that lift rare classes without letting them drown the rest: (median share / share) ** power.

    Args:
        pixels: (C,) of each class over all images, index 0 being void.
        power: 0 for equal weights.

    Returns:
        Float32 weights, None for equal ones.
    """
    if power == 0:
        return None
    share = np.maximum(pixels / pixels.sum(), 1e-5)
    weights = np.clip((np.median(share[1:]) / share) ** power, 0.5, 3.0)
    return torch.from_numpy(weights.astype(np.float32))
