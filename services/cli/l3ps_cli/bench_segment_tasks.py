"""The measurements of ``l3ps bench segment``, each the work of one process (see :mod:`l3ps_cli.bench_tasks`)."""

from __future__ import annotations

import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from l3ps.costs import peak_mb
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.images import network_input, open_image
from l3ps.segment.network import Network
from l3ps.segment.presets import SEGMENT_PRESETS, Fusion
from l3ps.segment.session import STEPS, Segmenter
from l3ps.segment.stream import in_order

WARM = 2


def segmentation(
    folder: Path,
    model: str,
    images: Sequence[str],
    segment: str,
    fusion: Fusion,
    min_area: float,
    threads: int,
    rounds: int,
) -> dict[str, Any]:
    """Rates of the whole and of the session alone, measured in turns, and the shares of the steps."""
    del folder
    bundle = ModelBundle.load(Path(model))
    preset = replace(SEGMENT_PRESETS[segment], fusion=fusion)
    clock = _Clock()
    segmenter = Segmenter(bundle, threads, min_area, preset, clock)
    own, default = Network(bundle, preset.name, threads), Network(bundle, preset.name, None)
    passes = preset.passes(bundle.info.output.boundary is not None)
    measured: dict[str, Callable[[Sequence[Path], Sequence[NDArray[np.float32]]], None]] = {
        "end_to_end": lambda paths, planes: _exhaust(segmenter.stream(paths)),
        "bare": lambda paths, planes: _exhaust(map(own.run, planes)),
        "bare_default_options": lambda paths, planes: _exhaust(map(default.run, planes)),
        "bare_side_by_side": lambda paths, planes: _exhaust(
            in_order(segmenter.network.run, planes, lanes=segmenter.lanes, ahead=2 * segmenter.lanes)
        ),
    }
    seconds: dict[str, list[float]] = {name: [] for name in measured}
    paths = [Path(image) for image in images]
    edges = np.linspace(0, len(paths), rounds + 1).astype(int).tolist()
    for turn, (begin, end) in enumerate(pairwise(edges)):
        chosen = paths[begin:end]
        spec = segmenter.network.spec
        prepared = {path: network_input(open_image(path), spec) for path in dict.fromkeys(chosen)}
        planes = [prepared[path] for path in chosen for _ in range(passes)]
        if turn == 0:
            for work in measured.values():
                work(chosen[:WARM], planes[:WARM])
            clock.reset()
        for name, work in measured.items():
            began = time.perf_counter()
            work(chosen, planes)
            seconds[name].append(time.perf_counter() - began)
    whole = seconds["end_to_end"]
    spent = sum(clock.seconds.values())
    return {
        "model": bundle.info.name,
        "input": [segmenter.network.spec.width, segmenter.network.spec.height],
        "segment": segment,
        "fusion": fusion,
        "passes": passes,
        "threads": threads,
        "count": len(paths),
        "rounds": rounds,
        "rates": {name: _rate(len(paths), sum(times)) for name, times in seconds.items()},
        "ratios": {
            name: statistics.median(bare / own for bare, own in zip(times, whole, strict=True))
            for name, times in seconds.items()
            if name != "end_to_end"
        },
        "round_seconds": seconds,
        "steps": {
            step: {"seconds_an_image": clock.seconds[step] / len(paths), "share": clock.seconds[step] / spent}
            for step in STEPS
        },
    }


def segmentation_memory(
    folder: Path, model: str, images: Sequence[str], segment: str, fusion: Fusion, min_area: float, threads: int
) -> dict[str, float]:
    """Highest memory of the process while it labels images, and before it had the model."""
    del folder
    preset = replace(SEGMENT_PRESETS[segment], fusion=fusion)
    before = peak_mb()
    segmenter = Segmenter(ModelBundle.load(Path(model)), threads, min_area, preset)
    _exhaust(segmenter.stream(Path(image) for image in images[: 4 * segmenter.lanes]))
    return {"before_mb": before, "peak_mb": peak_mb()}


class _Clock:
    """Seconds by step, added up over threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        with self._lock:
            self.seconds[step] += time.perf_counter() - began


def _exhaust(results: Any) -> None:
    for _ in results:
        pass


def _rate(count: int, seconds: float) -> dict[str, float]:
    return {"images_per_second": count / seconds, "seconds_an_image": seconds / count}


TASKS: dict[str, Callable[..., dict[str, Any]]] = {task.__name__: task for task in (segmentation, segmentation_memory)}
