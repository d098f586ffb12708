"""Single annotated pictures in a plain folder: something to train from for whoever has no annotations yet."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, Problem
from ..progress import Progress, silent
from ..taxonomy import NUSCENES16, VOID
from .camera import RIG, SKY, Picture
from .drive import WIDTH, annotated_images


def simulate_images(
    out: Path,
    count: int,
    seed: int,
    progress: Progress = silent,
    *,
    choose_from: int | None = None,
    width: int = WIDTH,
) -> None:
    """Write annotated pictures as ``images/``, ``semantic/`` and ``instance/``, with ``classes.json``.

    Class ids are those of ``NUSCENES16`` and 17 for sky. The same arguments give the same pixels. Nothing appears at
    ``out`` until everything is written.

    Args:
        out: the folder; must not exist or be empty.
        count: pictures to write.
        seed: of all randomness.
        progress: called with stage ``simulate`` after each picture drawn.
        choose_from: draw so many and keep those worth annotating (:func:`worth_annotating`); None keeps all drawn.
        width: of the pictures in pixels, a multiple of 16; the height is 9/16 of it.

    Raises:
        InputError: an argument is out of range or ``out`` is in use.
    """
    drawn = count if choose_from is None else choose_from
    _check(out, count, seed, drawn, width)
    staging = out.with_name(out.name + ".part")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        for folder in ("images", "semantic", "instance"):
            (staging / folder).mkdir(parents=True)
        pictures = []
        for done, picture in enumerate(annotated_images(drawn, seed, width), start=1):
            pictures.append(picture)
            progress("simulate", done, drawn)
        for i in worth_annotating([picture.semantic for picture in pictures], count):
            _write(staging, f"{i:04d}_{RIG[i % len(RIG)].channel}", pictures[i])
        (staging / "classes.json").write_text(json.dumps(_classes(), indent=1) + "\n")
        if out.exists():
            out.rmdir()
        staging.rename(out)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def worth_annotating(semantic: Sequence[NDArray[np.uint8]], count: int) -> list[int]:
    """The pictures an annotator would choose: again and again the one that adds most of what is still scarce.

    Args:
        semantic: classes of the pixels of each candidate, 0 void, up to :data:`SKY`.
        count: how many to choose.

    Returns:
        Their positions, ascending.
    """
    # A class counts in a picture by the square root of its pixels: present is what matters, large only helps.
    content = np.array([np.sqrt(np.bincount(s.ravel(), minlength=SKY + 1)[1:]) for s in semantic])
    total, chosen = np.ones(SKY), list[int]()
    for _ in range(min(count, len(content))):
        gain = (np.log(total + content) - np.log(total)).sum(axis=1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        total += content[chosen[-1]]
    return sorted(chosen)


def _write(folder: Path, stem: str, picture: Picture) -> None:
    for kind, array in (
        ("images", picture.rgb[..., ::-1]),
        ("semantic", picture.semantic),
        ("instance", picture.instance.astype(np.uint16)),
    ):
        _, png = cv2.imencode(".png", array)
        (folder / kind / f"{stem}.png").write_bytes(png.tobytes())


def _classes() -> dict[str, object]:
    names = {i: name for i, name in enumerate(NUSCENES16.classes) if i != VOID}
    entries = [{"id": i, "name": name, "nuscenes": name} for i, name in names.items()]
    return {"classes": [*entries, {"id": SKY, "name": "sky", "nuscenes": "void"}], "void": [VOID]}


def _check(out: Path, count: int, seed: int, drawn: int, width: int) -> None:
    least = (("count", count, 1), ("seed", seed, 0), ("choose-from", drawn, max(count, 1)), ("width", width, 64))
    problems = [
        Problem("out-of-range", name, f"{value} is too small; at least {lowest} is needed", f"Ask for {lowest} or more")
        for name, value, lowest in least
        if value < lowest
    ]
    if width % 16:
        what = f"{width} is not a multiple of 16"
        problems.append(Problem("out-of-range", "width", what, "Ask for a multiple of 16"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        problems.append(Problem("output-in-use", str(out), "it exists and is not empty", "Name a new directory"))
    if problems:
        raise InputError(problems)
