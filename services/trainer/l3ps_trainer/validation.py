"""How well a network labels images that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from l3ps.segment.bundle import InputSpec
from l3ps.segment.images import network_input

from .annotations import IGNORED, Annotated, AnnotationSet, spread
from .backbones import Backbone
from .export import Network
from .heads import Heads
from .reporting import Reporter, silent
from .runtime import session_of

EARLY_IMAGES = 8
"""Images that the figures during training are made of."""


class Confusion:
    """Pixels by true and found class, added up over images."""

    def __init__(self, classes: int) -> None:
        self.pixels = np.zeros((classes, classes), np.int64)

    def add(self, truth: NDArray[np.uint8], logits: NDArray[np.float32]) -> None:
        """Count one image at its truth's own resolution.

        Args:
            truth: (H, W) uint8, 0 ignored.
            logits: (C - 1, h, w) of the classes from 1 on, resized bilinearly to the truth before the arg max.
        """
        rows, columns = truth.shape
        found = cv2.resize(logits[0], (columns, rows), interpolation=cv2.INTER_LINEAR)
        guess = np.ones(truth.shape, np.uint8)
        for index, plane in enumerate(logits[1:], start=2):
            resized = cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_LINEAR)
            guess[resized > found] = index
            found = np.maximum(found, resized)
        known = truth != IGNORED
        classes = len(self.pixels)
        pairs = truth[known].astype(np.int64) * classes + guess[known]
        self.pixels += np.bincount(pairs, minlength=classes**2).reshape(classes, classes)

    def iou(self) -> NDArray[np.float64]:
        """(C,) per cent; nan for void and for classes that the truth never shows."""
        hit = np.diag(self.pixels).astype(np.float64)
        shown = self.pixels.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(shown > 0, 100 * hit / (shown + self.pixels.sum(axis=0) - hit), np.nan))

    def miou(self) -> float:
        """Mean over the classes that the truth shows, in per cent; nan where it shows none."""
        iou = self.iou()
        return float(np.nanmean(iou)) if np.isfinite(iou).any() else float("nan")


def score_graph(
    graph: Path, spec: InputSpec, annotations: AnnotationSet, threads: int, report: Reporter = silent
) -> Confusion:
    """Score an exported graph, prepared and run the way the product does.

    Args:
        graph: to run; its first class is that of index 1.
        spec: its input.
        annotations: images with truth.
        threads: of the runtime.
        report: told every image.
    """
    session, confusion = session_of(graph, threads), Confusion(len(annotations.classes))
    for done, named in enumerate(annotations.images, start=1):
        image = named.load()
        logits = session.run(["semantic"], {spec.name: network_input(Image.fromarray(image.rgb), spec)})[0][0]
        confusion.add(image.semantic, logits)
        report("validate", done, len(annotations.images), miou=confusion.miou())
    return confusion


def early_figure(
    backbone: Backbone, heads: Heads, annotations: AnnotationSet, device: torch.device
) -> Callable[[], float]:
    """A function that gives the mIoU on a few images as the network stands."""
    kept: list[tuple[Annotated, torch.Tensor]] = []

    def features(image: Annotated) -> torch.Tensor:
        found: torch.Tensor = backbone(
            torch.from_numpy(network_input(Image.fromarray(image.rgb), backbone.spec)).to(device)
        )
        return found

    @torch.no_grad()
    def score() -> float:
        if not kept:
            few = annotations.subset(spread(len(annotations.images), EARLY_IMAGES))
            loaded = [image.load() for image in few.images]
            kept.extend((image, torch.empty(0) if backbone.trainable else features(image)) for image in loaded)
        network, confusion = Network(backbone, heads), Confusion(len(annotations.classes))
        for image, known in kept:
            semantic = network.labelled(features(image) if backbone.trainable else known)[0]
            confusion.add(image.semantic, semantic[0].float().cpu().numpy())
        return confusion.miou()

    return score
