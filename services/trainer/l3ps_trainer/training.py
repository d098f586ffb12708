"""The training loop and the score on images never trained on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as f

from .network import PanopticNet
from .samples import IGNORED, Annotated, augmented, batch, normalised


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the result besides the images.

    Attributes:
        steps: optimiser steps.
        batch: views a step.
        crop: (height, width) of a view, multiples of 16.
        size: (height, width) at which the network sees whole images.
        rate: peak learning rate of Adam, falling to 0 along a cosine after a short warm-up.
        decay: weight decay.
        hardest: share of pixels whose cross-entropy counts.
        boundary_weight: of the boundary loss beside the semantic one.
        seed: of initial weights and views.
    """

    steps: int = 2200
    batch: int = 3
    crop: tuple[int, int] = (240, 432)
    size: tuple[int, int] = (288, 512)
    rate: float = 3e-3
    decay: float = 1e-4
    hardest: float = 0.5
    boundary_weight: float = 1.0
    seed: int = 1


def hard_cross_entropy(logits: Tensor, classes: Tensor, share: float, weights: Tensor | None = None) -> Tensor:
    """Mean cross-entropy over the hardest share of all labelled pixels of the batch.

    Args:
        logits: (B, C, H, W).
        classes: (B, H, W) int64, 0 ignored.
        share: 0..1.
        weights: (C,) of the classes, or None for equal ones.
    """
    loss = f.cross_entropy(logits, classes, weights, ignore_index=IGNORED, reduction="none")[classes != IGNORED]
    return loss.topk(max(1, int(share * loss.numel()))).values.mean()


def class_weights(images: Sequence[Annotated], classes: int) -> Tensor:
    """(C,) weights that lift rare classes without letting them drown the rest: (median share / share) ** 0.3."""
    counts = sum(np.bincount(image.semantic.ravel(), minlength=classes)[:classes] for image in images)
    share = np.maximum(np.asarray(counts, np.float64) / np.sum(counts), 1e-5)
    weights = np.clip((np.median(share[1:]) / share) ** 0.3, 0.5, 3.0)
    return torch.from_numpy(weights.astype(np.float32))


def _views(images: Sequence[Annotated], recipe: Recipe) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Batches of random views, every image as often as any other; made one ahead in a thread of their own."""
    rng = np.random.default_rng(recipe.seed)
    unit = recipe.size[0] / images[0].semantic.shape[0]
    order: list[int] = []

    def draw() -> tuple[Tensor, Tensor, Tensor]:
        while len(order) < recipe.batch:
            order.extend(int(i) for i in rng.permutation(len(images)))
        return batch([augmented(images[order.pop(0)], recipe.crop, unit, rng) for _ in range(recipe.batch)])

    with ThreadPoolExecutor(max_workers=1) as pool:
        ahead = pool.submit(draw)
        for _ in range(recipe.steps):
            ready, ahead = ahead.result(), pool.submit(draw)
            yield ready


def train(
    images: Sequence[Annotated], classes: int, recipe: Recipe, width: float = 1.0,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> PanopticNet:  # fmt: skip
    """Train a network from scratch; the same arguments give the same weights on the same machine.

    The share of pixels that count shrinks from all to the hardest during the first half: mined from the start, a
    network without pretrained weights learns little.

    Args:
        images: what is known.
        classes: number of classes.
        recipe: how.
        width: channel multiplier of the network.
        report: called with step and loss after each step.
    """
    torch.manual_seed(recipe.seed)
    network = PanopticNet(classes, width).train().to(memory_format=torch.channels_last)  # halves the time on CPUs
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, recipe.rate, total_steps=recipe.steps, pct_start=0.1)
    weights = class_weights(images, classes)
    for step, (inputs, targets, edges) in enumerate(_views(images, recipe)):
        semantic, inside = network.heads(inputs.to(memory_format=torch.channels_last))
        share = max(recipe.hardest, 1 - 2 * step / recipe.steps * (1 - recipe.hardest))
        loss = hard_cross_entropy(semantic, targets[:, ::2, ::2], share, weights)
        loss = loss + recipe.boundary_weight * f.binary_cross_entropy(inside[:, 0], edges)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        report(step, float(loss.detach()))
    return network.eval().to(memory_format=torch.contiguous_format)


@torch.no_grad()
def intersection_over_union(
    network: PanopticNet, images: Sequence[Annotated], classes: int, size: tuple[int, int]
) -> NDArray[np.float64]:
    """IoU per class over images, in per cent; nan for void and for classes without a labelled pixel.

    Args:
        network: in evaluation mode.
        images: annotated.
        classes: number of classes.
        size: (height, width) of the network's input.
    """
    confusion = np.zeros((classes, classes), np.int64)
    for image in images:
        small = cv2.resize(image.rgb, (size[1], size[0]), interpolation=cv2.INTER_AREA)
        logits, _ = network(torch.from_numpy(normalised(np.asarray(small, np.uint8)))[None])
        logits[:, IGNORED] = -torch.inf
        guess = logits[0].argmax(0).numpy().astype(np.uint8)
        guess = cv2.resize(guess, image.semantic.shape[::-1], interpolation=cv2.INTER_NEAREST)
        known = image.semantic != IGNORED
        np.add.at(confusion, (image.semantic[known], guess[known]), 1)
    hit = np.diag(confusion).astype(np.float64)
    union = confusion.sum(0) + confusion.sum(1) - hit
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(confusion.sum(1) > 0, 100 * hit / union, np.nan))
