"""Ways to look at an image, from one pass of the network to the published forty."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Fusion = Literal["components", "cuts"]
"""How things become objects: connected components of a class, or normalised cuts of them along the boundary map."""


@dataclass(frozen=True, slots=True)
class SegmentPreset:
    """What decides the labels of an image besides the model.

    Attributes:
        name: how the user asks for it; also that of the bundle's graph where it has several.
        semantic: tilings over which class probabilities are averaged; n stands for n × n tiles, each resized to the
            network's input.
        boundary: tilings over which the boundary map is averaged.
        fusion: see :data:`Fusion`.
    """

    name: Literal["fast", "balanced", "paper"]
    semantic: tuple[int, ...] = (1,)
    boundary: tuple[int, ...] = (1,)
    fusion: Fusion = "components"

    def passes(self, boundary: bool) -> int:
        """Passes of the network an image, with or without a boundary head."""
        return sum(n * n for n in {*self.semantic, *(self.boundary if boundary else ())})

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for content keys and reports."""
        return asdict(self)


FAST = SegmentPreset("fast")
"""One pass of ``model.onnx``."""
BALANCED = SegmentPreset("balanced")
"""One pass of the bundle's graph of that name, which takes a larger input."""
PAPER = SegmentPreset("paper", semantic=(1, 2, 3), boundary=(3, 4), fusion="cuts")
"""As published. One pass of a tile serves both heads, which makes 30 passes of the published 39."""

SEGMENT_PRESETS: dict[str, SegmentPreset] = {preset.name: preset for preset in (FAST, BALANCED, PAPER)}
DEFAULT_SEGMENT = FAST.name
