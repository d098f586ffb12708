"""A bundle ready to label images, one by one or a stream of files."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from PIL import Image

from l3ps.segment.bundle import ModelBundle
from l3ps.segment.cuts import fuse_cuts
from l3ps.segment.images import Box, network_input, open_image
from l3ps.segment.network import Network
from l3ps.segment.panoptic import PanopticImage, fuse
from l3ps.segment.presets import FAST, SegmentPreset
from l3ps.segment.scores import ClassScores, strongest
from l3ps.segment.stream import in_order
from l3ps.segment.tiles import at_size, averaged

LANES = 2
"""Images in work at a time. Two passes side by side take less time than one after the other on twice the threads,
and while one lane decodes, resizes or fuses, the other computes."""


STEPS = ("decode", "resize", "network", "label", "fuse")
"""What an image goes through."""

Clock = Callable[[str], AbstractContextManager[None]]
"""Entered around each of :data:`STEPS`, in the thread that takes it."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the network says of an image.

    Attributes:
        logits: (C, h, w) float32.
        inside: (h', w') float32 probability of lying inside an object, or None.
        size: (width, height) of the image.
    """

    logits: NDArray[np.float32]
    inside: NDArray[np.float32] | None
    size: tuple[int, int]


class Segmenter:
    """A bundle ready to label images. Create it after a fork: the runtime's threads do not survive one.

    An image goes through ``open_image``, :meth:`look` and :meth:`label`, in one thread from end to end;
    :meth:`stream` keeps :data:`LANES` of them going.

    Args:
        bundle: the model.
        threads: threads in work at a time, at least 1: the lanes and those that the runtime adds inside an operator.
        min_area: smallest object as a share of the image (see :func:`l3ps.segment.panoptic.fuse`).
        preset: how to look at an image.
        clock: told of every step, to measure it.

    Raises:
        ModelError: when the graph cannot be loaded or its inputs and outputs are not those of ``model.json``, or the
            bundle has no graph for the preset.
    """

    def __init__(
        self,
        bundle: ModelBundle,
        threads: int = 2,
        min_area: float = 0.0,
        preset: SegmentPreset = FAST,
        clock: Clock = lambda step: nullcontext(),
    ) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, not {threads}")
        self.bundle = bundle
        self.min_area = min_area
        self.preset = preset
        self._clock = clock
        self.lanes = min(threads, LANES)
        # All lanes share the threads that the session adds to each caller's own.
        self.network = Network(bundle, preset.name, threads - self.lanes + 1)

    def segment(self, image: NDArray[np.uint8]) -> PanopticImage:
        """Label one image.

        Args:
            image: (H, W, 3) uint8 RGB.

        Returns:
            Panoptic labels and class scores at the resolution of the network's output.
        """
        return self.label(self.look(Image.fromarray(image)))

    def stream(self, paths: Iterable[Path]) -> Generator[PanopticImage]:
        """Label image files, in order.

        At most ``2 * lanes`` images are in work or wait to be taken. Close the generator to stop before its end;
        nothing is left running then.

        Args:
            paths: the files; read in other threads, as results are asked for.

        Raises:
            DriveLogError: in the turn of an image that cannot be read.
        """
        options = ort.RunOptions()
        options.log_severity_level = 4  # a pass that is cut short is no error

        def stop() -> None:
            options.terminate = True

        def one(path: Path) -> PanopticImage:
            with self._clock("decode"):
                image = open_image(path)
            return self.label(self.look(image, options))

        return in_order(one, paths, lanes=self.lanes, ahead=2 * self.lanes, stop=stop)

    def look(self, image: Image.Image, options: ort.RunOptions | None = None) -> Seen:
        """The passes of the network that the preset asks for.

        Args:
            image: RGB.
            options: see :meth:`l3ps.segment.network.Network.run`.
        """
        spec = self.network.spec

        def one(box: Box | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
            with self._clock("resize"):
                planes = network_input(image, spec, box)
            with self._clock("network"):
                return self.network.run(planes, options)

        if self.preset.semantic == self.preset.boundary == (1,):
            return Seen(*one(), image.size)
        tilings = self.preset.semantic, self.preset.boundary if self.bundle.info.output.boundary else ()
        return Seen(*averaged(one, image.size, (spec.height, spec.width), *tilings), image.size)

    def label(self, seen: Seen) -> PanopticImage:
        """Classes, objects and the scores that are kept."""
        info = self.bundle.info
        with self._clock("label"):
            semantic = info.lut[strongest(seen.logits)]
            scores = ClassScores.compact(seen.logits, info.lut)
        with self._clock("fuse"):
            labels = self._fused(semantic, seen)
        return replace(labels, scores=scores)

    def _fused(self, semantic: NDArray[np.uint8], seen: Seen) -> PanopticImage:
        """Objects as the preset wants them; without a boundary map there is nothing to cut along."""
        threshold = self.bundle.info.output.boundary_threshold
        if seen.inside is None:
            return fuse(semantic, seen.size, min_area=self.min_area)
        if self.preset.fusion == "cuts":
            return fuse_cuts(semantic, seen.size, seen.inside, threshold=threshold, min_area=self.min_area)
        interior = at_size(seen.inside, semantic.shape) >= threshold
        return fuse(semantic, seen.size, interior=interior, min_area=self.min_area)
