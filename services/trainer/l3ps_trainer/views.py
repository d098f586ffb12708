"""Where the training steps' batches come from: views drawn anew, or a pool of views whose features are kept.

Which view a step sees, and how it is drawn, follows from the seed and the step alone. So a run that was killed goes on
with exactly the views that it would have seen.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from l3ps.segment.bundle import InputSpec
from l3ps.segment.images import network_input

from .annotations import AnnotationSet
from .augment import Size, View, draw
from .backbones import Backbone
from .recipe import Recipe
from .reporting import Reporter

KEPT_IMAGES = 64
"""Decoded images held in memory: 0.7 GB at 1600×900."""
POOL_BYTES = 4 << 30
"""Features that a pool may take on disk; it holds fewer views of each image where they would take more."""
NOTED_EVERY = 16
"""Views between two notes of how far the pool is."""


@dataclass(frozen=True)
class Batch:
    """What one step learns from.

    Attributes:
        inputs: (B, 3, H, W) images or (B, D, h, w) features, float32.
        semantic: (B, h', w') int64 class, 0 ignored.
        inside: (B, h'', w'') float32 target of the boundary head, or None.
        teaches: (B,) bool, whether the boundary head learns from a view.
    """

    inputs: Tensor
    semantic: Tensor
    inside: Tensor | None
    teaches: Tensor


class Source(Protocol):
    """Batches in their order."""

    is_features: bool

    @property
    def steps(self) -> int:
        """How many there are in a whole training."""

    def batches(self, start: int, end: int) -> Iterator[Batch]:
        """Batches of the steps from ``start`` up to ``end``."""


class Views:
    """Views drawn anew at every step, one batch ahead in a thread of its own.

    Args:
        annotations: what to draw from.
        spec: size and normalisation of a view.
        recipe: how.
        sizes: resolution of the semantic and of the boundary target.
        seed: of everything random.
    """

    is_features = False

    def __init__(
        self, annotations: AnnotationSet, spec: InputSpec, recipe: Recipe, sizes: tuple[Size, Size | None], seed: int
    ) -> None:
        self.annotations, self.spec, self.recipe, self.sizes, self.seed = annotations, spec, recipe, sizes, seed
        self._load = lru_cache(KEPT_IMAGES)(lambda index: annotations.images[index].load())

    @property
    def steps(self) -> int:
        """See :class:`Source`."""
        return math.ceil(self.recipe.epochs * len(self.annotations.images) / self.recipe.batch)

    def seen(self, step: int) -> list[tuple[int, int]]:
        """(epoch, image) of each view of a step; every image once an epoch, in an order of its own."""
        count, batch = len(self.annotations.images), self.recipe.batch
        epochs = [divmod(n, count) for n in range(step * batch, (step + 1) * batch)]
        orders = {epoch: np.random.default_rng([self.seed, epoch]).permutation(count) for epoch, _ in epochs}
        return [(epoch, int(orders[epoch][position])) for epoch, position in epochs]

    def view(self, epoch: int, image: int) -> View:
        """The view of an image in an epoch."""
        rng = np.random.default_rng([self.seed, epoch, image])
        size = (self.spec.height, self.spec.width)
        return draw(self._load(image), self.recipe.augmentation, rng, size, *self.sizes)

    def tensor(self, view: View) -> Tensor:
        """(1, 3, H, W) network input of a view."""
        return torch.from_numpy(network_input(Image.fromarray(view.rgb), self.spec))

    def batches(self, start: int, end: int) -> Iterator[Batch]:
        """See :class:`Source`."""

        def made(step: int) -> Batch:
            views = [self.view(*which) for which in self.seen(step)]
            borders = [v.inside for v in views if v.inside is not None]
            return Batch(
                torch.cat([self.tensor(v) for v in views]),
                torch.from_numpy(np.stack([v.semantic for v in views]).astype(np.int64)),
                torch.from_numpy(np.stack(borders).astype(np.float32)) if borders else None,
                torch.tensor([v.teaches_boundary for v in views]),
            )

        with ThreadPoolExecutor(max_workers=1) as pool:
            ahead = pool.submit(made, start)
            for step in range(start, end):
                ready = ahead.result()
                if step + 1 < end:
                    ahead = pool.submit(made, step + 1)
                yield ready


class Pool:
    """A fixed number of views of each image, their features computed once and kept on disk as float16.

    Args:
        views: draws them.
        folder: of the work in progress.
        shape: (D, h, w) of the features.
    """

    is_features = True

    def __init__(self, views: Views, folder: Path, shape: tuple[int, int, int]) -> None:
        self._views, self._images = views, len(views.annotations.images)
        fitting = POOL_BYTES // (2 * self._images * int(np.prod(shape)))
        self.each = max(1, min(self._wanted(), fitting))
        self._note = folder / "pool.json"
        count = self._images * self.each
        self._planes = self._plan(count, shape)
        self._files = {name: folder / f"pool-{name}.raw" for name in self._planes}
        self._arrays: dict[str, np.memmap[Any, Any]] = {}

    @property
    def steps(self) -> int:
        """See :class:`Source`."""
        return self._views.steps

    def _wanted(self) -> int:
        """Views of each image."""
        return min(self._views.recipe.views or 1, self._views.recipe.epochs)

    def _plan(self, count: int, shape: tuple[int, int, int]) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Type and shape of each file."""
        semantic, boundary = self._views.sizes
        return {
            "features": ("float16", (count, *shape)),
            "semantic": ("uint8", (count, *semantic)),
            "inside": ("uint8", (count, *(boundary or (1, 1)))),
            "teaches": ("uint8", (count,)),
        }

    def fill(self, backbone: Backbone, device: torch.device, report: Reporter) -> None:
        """Compute what is missing; what an earlier run of the same settings left is kept."""
        done, count = self._opened(), self._images * self.each
        for index in range(done, count):
            view = self._views.view(*divmod(index, self._images))
            with torch.no_grad():
                features = backbone(self._views.tensor(view).to(device))[0]
            self._keep(index, view, features)
            if (index + 1) % NOTED_EVERY == 0 or index + 1 == count:
                self._noted(index + 1)
            report("features", index + 1, count)

    def _keep(self, index: int, view: View, features: Tensor) -> None:
        """Write down what is kept of a view and its (D, h, w) features."""
        self._arrays["features"][index] = features.cpu().numpy().astype(np.float16)
        self._arrays["semantic"][index] = view.semantic
        if view.inside is not None:
            self._arrays["inside"][index] = view.inside
        self._arrays["teaches"][index] = view.teaches_boundary

    def batches(self, start: int, end: int) -> Iterator[Batch]:
        """See :class:`Source`."""
        with_boundary = self._views.sizes[1] is not None
        for step in range(start, end):
            rows = [(epoch % self.each) * self._images + image for epoch, image in self._views.seen(step)]
            planes = {name: torch.from_numpy(np.stack([a[row] for row in rows])) for name, a in self._arrays.items()}
            yield Batch(
                planes["features"].float(),
                planes["semantic"].long(),
                planes["inside"].float() if with_boundary else None,
                planes["teaches"].bool(),
            )

    def remove(self) -> None:
        """Free the disk."""
        self._arrays.clear()
        for path in (self._note, *self._files.values()):
            path.unlink(missing_ok=True)

    def _opened(self) -> int:
        """Map the files, made anew where they are not of this pool, and tell how many views they hold."""
        planes = json.loads(json.dumps(self._planes))
        try:
            note = json.loads(self._note.read_text())
        except (FileNotFoundError, ValueError):
            note = {}
        kept = note.get("planes") == planes and all(path.is_file() for path in self._files.values())
        for name, (kind, shape) in self._planes.items():
            mode: Any = "r+" if kept else "w+"
            self._arrays[name] = np.memmap(self._files[name], dtype=kind, mode=mode, shape=shape)
        return int(note["done"]) if kept else 0

    def _noted(self, done: int) -> None:
        for array in self._arrays.values():
            array.flush()
        partial = self._note.with_suffix(".partial")
        partial.write_text(json.dumps({"planes": self._planes, "done": done}))
        partial.replace(self._note)
