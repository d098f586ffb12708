"""Backbones: what turns an image into features. ``open_backbone`` knows them all by the name a user types."""

from __future__ import annotations

from pathlib import Path

from l3ps.errors import ModelError, Problem

from .base import Backbone
from .dinov2 import VARIANTS, DinoV2, fetch
from .onnx_graph import OnnxGraph
from .scratch import Scratch

__all__ = ["VARIANTS", "Backbone", "DinoV2", "OnnxGraph", "Scratch", "open_backbone"]


def open_backbone(
    name: str, weights: Path | None, size: tuple[int, int] | None, *, default_size: tuple[int, int], aspect: float,
    threads: int = 2,
) -> Backbone:  # fmt: skip
    """The backbone that a user asked for.

    Args:
        name: ``dinov2-s|b|l|g`` with optional ``-reg``, ``onnx:PATH`` or ``scratch``.
        weights: file of a DINOv2, or None to download it.
        size: (height, width) of the input, or None for the recipe's (a graph's own).
        default_size: (height, width) of the recipe.
        aspect: width / height of the annotated images; of several graphs the best fit is taken.
        threads: of an ONNX graph.

    Raises:
        ModelError: there is no such backbone, or no pretrained weights of it.
    """
    if name.startswith("onnx:"):
        return OnnxGraph(Path(name.removeprefix("onnx:")), size, aspect, threads)
    if name == "scratch":
        return Scratch(size or default_size)
    if name not in VARIANTS:
        what = f"there is no backbone '{name}'"
        raise ModelError(Problem("unknown-backbone", "--backbone", what, f"Use {known_names()}."))
    return DinoV2(name, fetch(name, weights), size or default_size)


def known_names() -> str:
    """The names a user may type, for a sentence."""
    return f"{', '.join(VARIANTS)}, onnx:PATH or scratch"
