"""Opening annotations: find which format a folder has, and hand it to the reader."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal, Protocol, get_args

from l3ps.drivelog import UnpackLimits, unpack
from l3ps.drivelog.names import subfolders
from l3ps.errors import AnnotationError, Problem
from l3ps.progress import Progress, silent

from . import cityscapes, coco, nuimages, plain
from .types import AnnotationSet

Format = Literal["auto", "plain", "cityscapes", "coco", "nuimages"]
_NESTING: Final = 3
"""Folders an archive may wrap around the annotations."""


class _Reader(Protocol):
    def __call__(self, folder: Path, classes: Path | None, images: int | None, progress: Progress) -> AnnotationSet:
        """Read a folder of one format."""


_FORMATS: Final[dict[str, tuple[str, Callable[[Path], bool], _Reader]]] = {
    "plain": (plain.LAYOUT, plain.is_plain, plain.read_plain),
    "cityscapes": (cityscapes.LAYOUT, cityscapes.is_cityscapes, cityscapes.read_cityscapes),
    "nuimages": (nuimages.LAYOUT, nuimages.is_nuimages, nuimages.read_nuimages),
    "coco": (coco.LAYOUT, coco.is_coco, coco.read_coco),
}
"""By name: what is looked for, whether a folder has it, and the reader."""


def open_annotations(
    path: Path,
    *,
    format: Format = "auto",
    classes: Path | None = None,
    images: int | None = None,
    progress: Progress = silent,
) -> AnnotationSet:
    """Open annotated images.

    Args:
        path: the folder, or one around it that holds no other folder.
        format: of the annotations; ``auto`` tells it by the layout.
        classes: a classes file (:mod:`~.classes`); None takes what the format means by itself.
        images: take so many, spread evenly over all in the order of their names; None takes all.
        progress: told the annotations looked at (stage ``annotations``); may raise to stop.

    Returns:
        The images with everything but their pictures' pixels checked; a picture is read when it is asked for.

    Raises:
        AnnotationError: no annotations there, or with what is wrong with them, up to a bound.
    """
    if format not in get_args(Format):
        raise ValueError(f"format is one of {', '.join(get_args(Format))}, not {format!r}")
    if images is not None and images < 1:
        raise AnnotationError(Problem("out-of-range", "images", f"{images} images are none", "Ask for 1 or more"))
    if not path.is_dir():
        what = "it is a file, not a folder" if path.exists() else "there is no such file or folder"
        raise AnnotationError(Problem("no-annotations", str(path), what, "Name the folder of the annotated images"))
    folder = path.resolve()
    wanted = [_FORMATS[format]] if format != "auto" else list(_FORMATS.values())
    for _ in range(_NESTING + 1):
        for _, fits, read in wanted:
            if fits(folder):
                return read(folder, classes, images, progress)
        inner = subfolders(folder)
        if len(inner) != 1:
            break
        folder = inner[0]
    what = f"no annotated images found in it: looked for {'; '.join(layout for layout, _, _ in wanted)}"
    remedy = "Name a folder of this layout" if len(wanted) == 1 else "Name a folder of one of these layouts"
    raise AnnotationError(Problem("no-annotations", path.name or str(path), what, remedy))


@contextmanager
def opened_annotations(
    path: Path,
    scratch: Path | None = None,
    limits: UnpackLimits | None = None,
    *,
    format: Format = "auto",
    classes: Path | None = None,
    images: int | None = None,
    progress: Progress = silent,
) -> Iterator[AnnotationSet]:
    """Annotations from a folder or an archive; what was unpacked is removed at the end.

    Args:
        path: the folder or archive.
        scratch: where to unpack; the system's temporary folder when None.
        limits: what an archive may grow to; None takes the usual ones.
        format, classes, images, progress: as for :func:`open_annotations`; progress is told the unpacking too.

    Raises:
        AnnotationError: as :func:`open_annotations`.
        DriveLogError: an archive that cannot be unpacked.
    """
    if not path.is_file():
        yield open_annotations(path, format=format, classes=classes, images=images, progress=progress)
        return
    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="annotations-", dir=scratch) as folder:
        target = Path(folder) / path.name  # its name is what messages show
        root = unpack(path, target, limits or UnpackLimits(), contents="images", progress=progress)
        yield open_annotations(root, format=format, classes=classes, images=images, progress=progress)
