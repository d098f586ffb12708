"""Train the demo's model from thirty simulated annotated images: ``python -m l3ps_trainer.demo_model --out DIR``.

Writes ``model.onnx``, ``model.json``, ``report.json`` (settings, scores) and ``RECIPE.md`` (the same for
people). Training images come from seeds that neither demo nor tests use.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from l3ps.simulate import annotated_images

from .annotations import NUSCENES_AND_SKY, Annotated, AnnotationSet
from .recipe import SCRATCH
from .reporting import bars, stoppable
from .run import Request, fit

NAME = "demo-simulated-k30"
TRAIN_IMAGES, TRAIN_SEED = 30, 1000
CANDIDATES = 90
"""Pictures from which the thirty worth annotating are chosen."""
CHECK_IMAGES, CHECK_SEED = 24, 2000
SEED = 1


def annotated(count: int, seed: int) -> list[Annotated]:
    """Simulated annotated images."""
    return [Annotated(p.rgb, p.semantic, p.instance.astype(np.int32)) for p in annotated_images(count, seed)]


def worth_annotating(candidates: list[Annotated], count: int) -> list[Annotated]:
    """The pictures an annotator would choose: again and again the one that adds most of what is still scarce.

    Args:
        candidates: to choose from.
        count: how many.
    """
    # A class counts in a picture by the square root of its pixels: present is what matters, large only helps.
    content = np.array(
        [np.sqrt(np.bincount(c.semantic.ravel(), minlength=len(NUSCENES_AND_SKY))[1:]) for c in candidates]
    )
    total, chosen = np.ones(content.shape[1]), list[int]()
    for _ in range(count):
        gain = (np.log(total + content) - np.log(total)).sum(axis=1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        total += content[chosen[-1]]
    return [candidates[i] for i in sorted(chosen)]


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


def _page(report: dict[str, Any]) -> str:
    rows = "\n".join(
        f"| {n} | {'–' if v is None else f'{v:.1f}'} |" for n, v in report["validation"]["classes"].items()
    )
    return f"""# The demo's model

Made by `make demo-model` (`python -m l3ps_trainer.demo_model`), which repeats it from {TRAIN_IMAGES} simulated
annotated images and nothing else. They are the ones worth annotating among {CANDIDATES} pictures of as many streets
(seed {TRAIN_SEED}): those that show what is scarce. The demo and the tests use other seeds. All settings are in
`report.json`.

- file: {report["bytes"]} bytes
- training: {report["seconds"]["train"]:.0f} s on the CPU, {report["steps"]} steps
- mean IoU on {CHECK_IMAGES} images of seed {CHECK_SEED}, which the network has never seen:
  {report["validation"]["miou"]:.1f}
- torch and ONNX Runtime: probabilities differ by at most {report["agreement"]["probability"]:.1e}
- a pixel separates two segments where the boundary map is below {SCRATCH.boundary_threshold}

| class | IoU |
|---|---|
{rows}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="directory for the bundle")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; more spin when the machine is busy")
    parser.add_argument("--epochs", type=int, default=SCRATCH.epochs, help="how often every image is seen")
    arguments = parser.parse_args()
    known = AnnotationSet.of(NUSCENES_AND_SKY, worth_annotating(annotated(CANDIDATES, TRAIN_SEED), TRAIN_IMAGES))
    unseen = AnnotationSet.of(NUSCENES_AND_SKY, annotated(CHECK_IMAGES, CHECK_SEED))
    request = Request(
        Path(), "scratch", arguments.out, NAME, epochs=arguments.epochs, threads=arguments.threads, seed=SEED
    )
    with stoppable() as stop, bars(stop, Console(stderr=True)) as report:
        result = fit(request, known, unseen, report)
    page = _page(result)
    (arguments.out / "RECIPE.md").write_text(page)
    sys.stderr.write(page)


if __name__ == "__main__":
    main()
