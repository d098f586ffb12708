"""Single annotated pictures in a plain folder: something to train from for whoever has no annotations yet."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..progress import Progress, silent
from ..taxonomy import NUSCENES16, VOID
from .camera import RIG, SKY, Picture
from .drive import WIDTH, annotated_images
from .output import check_arguments, whole

_KINDS = ("images", "semantic", "instance")


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
    least = (("count", count, 1), ("seed", seed, 0), ("choose-from", drawn, max(count, 1)))
    check_arguments(out, width, least)
    with whole(out) as staging:
        for folder in _KINDS:
            (staging / folder).mkdir()

        def written() -> Iterator[NDArray[np.uint8]]:  # one picture in memory at a time
            for done, picture in enumerate(annotated_images(drawn, seed, width), start=1):
                _write(staging, _stem(done - 1), picture)
                progress("simulate", done, drawn)
                yield picture.semantic

        kept = worth_annotating(written(), count)
        for i in set(range(drawn)).difference(kept):
            for kind in _KINDS:
                (staging / kind / f"{_stem(i)}.png").unlink()
        (staging / "classes.json").write_text(json.dumps(_classes(), indent=1) + "\n")


def worth_annotating(semantic: Iterable[NDArray[np.uint8]], count: int) -> list[int]:
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


def _stem(index: int) -> str:
    return f"{index:04d}_{RIG[index % len(RIG)].channel}"


def _write(folder: Path, stem: str, picture: Picture) -> None:
    planes: tuple[NDArray[Any], ...] = (picture.rgb[..., ::-1], picture.semantic, picture.instance.astype(np.uint16))
    for kind, array in zip(_KINDS, planes, strict=True):
        _, png = cv2.imencode(".png", array)
        (folder / kind / f"{stem}.png").write_bytes(png.tobytes())


def _classes() -> dict[str, object]:
    names = {i: name for i, name in enumerate(NUSCENES16.classes) if i != VOID}
    entries = [{"id": i, "name": name, "nuscenes": name} for i, name in names.items()]
    return {"classes": [*entries, {"id": SKY, "name": "sky", "nuscenes": "void"}], "void": [VOID]}
