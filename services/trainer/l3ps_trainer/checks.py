"""What is looked at before anything is trained, so that no hour of work ends in a refusal."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from l3ps.errors import InputError, Problem
from l3ps.segment.bundle import NAME_PATTERN

from .annotations import AnnotationSet


def check_name(name: str) -> None:
    """Refuse what no bundle may be called."""
    if not re.match(NAME_PATTERN, name) or len(name) > 100:
        what = f"{name!r} is no name of a model"
        remedy = "Take up to 100 letters, digits, dots, dashes and underscores, a letter or digit first."
        raise InputError(Problem("bad-name", "--name", what, remedy))


def check_out(out: Path, work: Path) -> None:
    """Refuse a folder that holds what no training wrote: nothing of a user's is ever replaced.

    Args:
        out: where the bundle is to go.
        work: the folder in it for work in progress, which a training leaves behind.
    """
    if not out.exists():
        return
    others = out.is_dir() and any(path != work for path in out.iterdir())
    if not out.is_dir() or (others and not (work / "checkpoint.pt").is_file()):
        what = "it is in use, and not by a training"
        raise InputError(Problem("output-in-use", str(out), what, "Name a new folder with --out."))


def check_classes(known: AnnotationSet) -> None:
    """Refuse classes of which none would label a point."""
    if not any(known.classes.to_nuscenes):
        what = "every class counts as void, so no point would ever get a label"
        remedy = "Say in the classes file which class of Panoptic nuScenes each counts as."
        raise InputError(Problem("only-void", "--classes", what, remedy))


def fingerprints(images: AnnotationSet) -> list[str]:
    """A digest of each image and its annotation.

    Decodes every file, so damage behind a file's header is found here, too.

    Raises:
        AnnotationError: a file is damaged.
    """
    found = []
    for image in images.images:
        content = image.load()
        digest = hashlib.sha256(content.rgb.tobytes())
        digest.update(content.semantic.tobytes())
        if content.instance is not None:
            digest.update(content.instance.tobytes())
        found.append(digest.hexdigest())
    return found


def check_apart(known: list[str], unseen: list[str]) -> None:
    """Refuse to score on what was learnt by heart."""
    shared = len(set(known) & set(unseen))
    if shared:
        what = f"{shared} of its {len(unseen)} images are training images, so the score would say nothing"
        remedy = "Name other images, or a share to set aside, such as 0.2."
        raise InputError(Problem("validation-is-training", "--validation", what, remedy))
