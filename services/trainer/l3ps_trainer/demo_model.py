"""Train the demo's model from thirty simulated annotated images: ``python -m l3ps_trainer.demo_model --out DIR``.

Writes ``model.onnx``, ``model.json``, ``recipe.json`` (seeds, settings, scores) and ``RECIPE.md`` (the same for
people). Training images come from seeds that neither demo nor tests use.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from l3ps.simulate import annotated_images

from .bundle import CLASSES, export
from .samples import Annotated
from .training import Recipe, intersection_over_union, train

NAME = "demo-simulated-k30"
TRAIN_IMAGES, TRAIN_SEED = 30, 1000
CANDIDATES = 90
"""Pictures from which the thirty worth annotating are chosen."""
CHECK_IMAGES, CHECK_SEED = 24, 2000
THRESHOLD = 0.5
"""Of the boundary map; see RECIPE.md."""


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
    content = np.array([np.sqrt(np.bincount(c.semantic.ravel(), minlength=len(CLASSES))[1:]) for c in candidates])
    total, chosen = np.ones(content.shape[1]), list[int]()
    for _ in range(count):
        gain = (np.log(total + content) - np.log(total)).sum(axis=1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        total += content[chosen[-1]]
    return [candidates[i] for i in sorted(chosen)]


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


def _table(recipe: dict[str, Any], iou: dict[str, float | None]) -> str:
    rows = "\n".join(f"| {name} | {'–' if value is None else f'{value:.1f}'} |" for name, value in iou.items())
    return f"""# The demo's model

Made by `make demo-model` (`python -m l3ps_trainer.demo_model`), which repeats it from {TRAIN_IMAGES} simulated
annotated images and nothing else. They are the ones worth annotating among {CANDIDATES} pictures of as many streets
(seed {TRAIN_SEED}): those that show what is scarce. The demo and the tests use other seeds. All settings are in
`recipe.json`.

- parameters: {recipe["parameters"]}, file {recipe["bytes"]} bytes
- training: {recipe["seconds"]} s on the CPU, {recipe["training"]["steps"]} steps of {recipe["training"]["batch"]} views
- mean IoU on {CHECK_IMAGES} images of seed {CHECK_SEED}, which the network has never seen: {recipe["miou"]:.1f}
- torch and ONNX Runtime differ by at most {recipe["onnx_difference"]:.1e}
- a pixel separates two segments where the boundary map is below {THRESHOLD}

| class | IoU |
|---|---|
{rows}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="directory for the bundle")
    parser.add_argument(
        "--threads", type=int, default=1, help="CPU threads; more of them spin when the machine is busy"
    )
    parser.add_argument("--steps", type=int, default=Recipe.steps, help="optimiser steps")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.use_deterministic_algorithms(True)
    settings = Recipe(steps=arguments.steps)

    began = time.monotonic()
    _say(f"drawing {CANDIDATES} pictures to choose {TRAIN_IMAGES} from, and {CHECK_IMAGES} to check on")
    known = worth_annotating(annotated(CANDIDATES, TRAIN_SEED), TRAIN_IMAGES)
    unseen = annotated(CHECK_IMAGES, CHECK_SEED)
    _say(f"  {time.monotonic() - began:.0f} s")

    def report(step: int, loss: float) -> None:
        if step % 50 == 0:
            _say(f"  step {step}/{settings.steps}  loss {loss:.3f}  {time.monotonic() - began:.0f} s")

    network = train(known, len(CLASSES), settings, report=report)
    scores = intersection_over_union(network, unseen, len(CLASSES), settings.size)
    learnt = intersection_over_union(network, known, len(CLASSES), settings.size)
    _say(f"mean IoU on the training images themselves {np.nanmean(learnt):.1f}")
    difference = export(network, arguments.out, NAME, settings.size, THRESHOLD)
    recipe: dict[str, Any] = {
        "name": NAME,
        "train": {"images": TRAIN_IMAGES, "chosen_from": CANDIDATES, "seed": TRAIN_SEED},
        "check": {"images": CHECK_IMAGES, "seed": CHECK_SEED},
        "training": asdict(settings),
        "boundary_threshold": THRESHOLD,
        "parameters": sum(p.numel() for p in network.parameters()),
        "bytes": (arguments.out / "model.onnx").stat().st_size,
        "seconds": round(time.monotonic() - began),
        "torch": torch.__version__,
        "onnx_difference": difference,
        "miou": float(np.nanmean(scores)),
    }
    iou = {name: None if np.isnan(s) else round(float(s), 1) for name, s in zip(CLASSES, scores, strict=True)}
    recipe["iou"] = {name: value for name, value in iou.items() if name != CLASSES[0]}
    (arguments.out / "recipe.json").write_text(json.dumps(recipe, indent=2) + "\n")
    (arguments.out / "RECIPE.md").write_text(_table(recipe, dict(list(iou.items())[1:])))
    _say((arguments.out / "RECIPE.md").read_text())


if __name__ == "__main__":
    main()
