"""The training loop: resumable, stoppable, the same weights from the same seed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from . import checkpoint
from .annotations import AnnotationSet
from .backbones import Backbone
from .heads import Heads, output_sizes
from .losses import boundary_loss, class_weights, hard_cross_entropy
from .pixels import PixelPool
from .recipe import Recipe
from .reporting import Reporter, silent
from .views import Batch, Pool, Source, Views

CPU = torch.device("cpu")
SAVED_EVERY = 15.0
"""Seconds between checkpoints."""
TRIALS = 5
"""How often the early figure of validation is made."""


@dataclass
class Course:
    """How a training went.

    Attributes:
        steps: optimiser steps in all.
        seconds: by step (``features``, ``train``), over all runs.
        losses: (step, mean loss of the steps since the last entry).
        scores: (step, validation mIoU of a few images).
        views: distinct views of each image.
    """

    steps: int
    seconds: dict[str, float] = field(default_factory=dict)
    losses: list[tuple[int, float]] = field(default_factory=list)
    scores: list[tuple[int, float]] = field(default_factory=list)
    views: int = 0


def train(
    backbone: Backbone,
    heads: Heads,
    annotations: AnnotationSet,
    recipe: Recipe,
    folder: Path,
    settings: dict[str, Any],
    *,
    seed: int = 0,
    device: torch.device = CPU,
    report: Reporter = silent,
    score: Callable[[], float] | None = None,
) -> Course:
    """Train heads, and the backbone where it is trainable, in place.

    The same arguments give the same weights on the same machine, whether or not the run was interrupted.

    Args:
        backbone: gives the features.
        heads: with initial weights made from the same seed.
        annotations: what to learn from.
        recipe: how.
        folder: for checkpoint and features; exists.
        settings: everything that decides the weights; a checkpoint of others is refused.
        seed: of views and dropout.
        device: where the network is.
        report: told every step; may raise to stop, after which the checkpoint is up to date.
        score: gives the early figure, or None.

    Raises:
        InputError: the folder holds a training with other settings.
        Cancelled: from ``report``.
    """
    source = _source(backbone, heads, annotations, recipe, folder, seed, device)
    total = source.steps
    run = _Run(backbone, heads, recipe, folder, settings, total)
    start = run.resume()
    run.course.views = source.each if isinstance(source, Pool) else recipe.epochs
    if isinstance(source, Pool) and start < total:
        began = time.monotonic()
        source.fill(backbone, device, report)
        run.course.seconds["features"] = run.course.seconds.get("features", 0.0) + time.monotonic() - began
    # Of single pixels those of rare classes are drawn more often in place of weighing more.
    weights = None if recipe.pixels else class_weights(annotations.counts(), recipe.class_power)
    weights = weights if weights is None else weights.to(device)
    mean = _Mean()
    run.begin()
    try:
        for step, batch in enumerate(source.batches(start, total), start=start):
            torch.manual_seed(seed * 1_000_003 + step)  # dropout is a function of the step too
            loss = run.step(step, _moved(batch, device), source.is_features, weights)
            mean.add(loss)
            figures = {"loss": loss}
            if score is not None and (step + 1) % max(1, total // TRIALS) == 0 and step + 1 < total:
                figures["miou"] = _scored(run, score, step + 1)
            if (step + 1) % max(1, total // 100) == 0:
                run.course.losses.append((step + 1, mean.taken()))
            run.saved(step + 1)
            report("train", step + 1, total, **figures)
    finally:
        run.saved(min(run.finished, total), always=True)
    if isinstance(source, Pool):
        source.remove()
    backbone.eval()
    heads.eval()
    return run.course


class _Run:
    """Network, optimiser and where they are."""

    def __init__(
        self, backbone: Backbone, heads: Heads, recipe: Recipe, folder: Path, settings: dict[str, Any], total: int
    ) -> None:
        self.backbone, self.heads, self.recipe, self.folder, self.settings = backbone, heads, recipe, folder, settings
        self.learning = nn.ModuleList([heads, backbone] if backbone.trainable else [heads]).train()
        self.optimiser = torch.optim.AdamW(self.learning.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        self.course, self.total, self.finished = Course(total), total, 0
        self.begin()
        if backbone.trainable:  # halves the time of convolutions on CPUs
            self.learning.to(memory_format=torch.channels_last)

    def begin(self) -> None:
        """The clock of the steps runs from here."""
        self._began = self._saved = time.monotonic()

    def resume(self) -> int:
        """Take up the checkpoint where there is one; the next step's number."""
        content = checkpoint.load(self.folder, self.settings)
        if content is not None:
            self.learning.load_state_dict(content["weights"])
            self.optimiser.load_state_dict(content["optimiser"])
            course = content["course"]
            self.course = Course(self.total, course["seconds"], course["losses"], course["scores"])
            self.finished = content["step"]
        return self.finished

    def step(self, number: int, batch: Batch, is_features: bool, weights: Tensor | None) -> float:
        """One optimiser step; the loss."""
        recipe, part = self.recipe, number / self.total
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate * schedule(part, recipe.warm_up)
        features = batch.inputs if is_features else self._features(batch.inputs)
        semantic, boundary = self.heads(features)
        loss = hard_cross_entropy(semantic, batch.semantic, mined(part, recipe), weights)
        if boundary is not None and batch.inside is not None:
            loss = loss + recipe.boundary_weight * boundary_loss(boundary, batch.inside, batch.teaches)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.finished = number + 1
        return float(loss.detach())

    def saved(self, step: int, *, always: bool = False) -> None:
        """Write a checkpoint when the last one is old."""
        now = time.monotonic()
        if not always and now - self._saved < SAVED_EVERY:
            return
        seconds = self.course.seconds
        seconds["train"] = seconds.get("train", 0.0) + now - self._began
        self._began = self._saved = now
        course = {"seconds": dict(seconds), "losses": self.course.losses, "scores": self.course.scores}
        content = {
            "step": step,
            "weights": self.learning.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "course": course,
        }
        checkpoint.save(self.folder, content, self.settings)

    def _features(self, images: Tensor) -> Tensor:
        if self.backbone.trainable:
            out: Tensor = self.backbone(images.to(memory_format=torch.channels_last))
            return out
        with torch.no_grad():
            frozen: Tensor = self.backbone(images)
        return frozen


def schedule(part: float, warm_up: float) -> float:
    """Share of the peak rate after a part of the steps: up in a line, then down along a cosine to 0."""
    if part < warm_up:
        return 0.04 + 0.96 * part / warm_up
    return 0.5 * (1 + math.cos(math.pi * (part - warm_up) / (1 - warm_up)))


def mined(part: float, recipe: Recipe) -> float:
    """Share of the pixels that count after a part of the steps."""
    if part >= recipe.mine_from:
        return recipe.hardest
    return 1 - (1 - recipe.hardest) * part / recipe.mine_from


class _Mean:
    """Mean of what was added since it was last taken."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0

    def add(self, value: float) -> None:
        self._sum, self._count = self._sum + value, self._count + 1

    def taken(self) -> float:
        value = self._sum / max(1, self._count)
        self._sum, self._count = 0.0, 0
        return value


def _scored(run: _Run, score: Callable[[], float], step: int) -> float:
    run.learning.eval()
    miou = score()
    run.learning.train()
    run.course.scores.append((step, miou))
    return miou


def _moved(batch: Batch, device: torch.device) -> Batch:
    inside = None if batch.inside is None else batch.inside.to(device)
    return Batch(batch.inputs.to(device), batch.semantic.to(device), inside, batch.teaches.to(device))


def _source(
    backbone: Backbone, heads: Heads, annotations: AnnotationSet, recipe: Recipe, folder: Path, seed: int,
    device: torch.device,
) -> Source:  # fmt: skip
    spec = backbone.spec
    if recipe.view_size is not None and backbone.trainable:
        spec = spec.model_copy(update={"height": recipe.view_size[0], "width": recipe.view_size[1]})
    training = backbone.training
    with torch.no_grad():
        features = backbone.eval()(torch.zeros((1, 3, spec.height, spec.width), device=device))
    backbone.train(training)
    channels, *grid = features.shape[1:]
    semantic, boundary = output_sizes(heads, channels, (grid[0], grid[1]))
    if recipe.pixels and not backbone.trainable:
        views = Views(annotations, spec, recipe, ((spec.height, spec.width), boundary), seed)
        return PixelPool(views, folder, channels)
    views = Views(annotations, spec, recipe, (semantic, boundary), seed)
    if recipe.views is None or backbone.trainable:
        return views
    return Pool(views, folder, (channels, grid[0], grid[1]))
