"""SemanticKITTI label files.

``sequences/<scene>/predictions/<number>.label`` holds one uint32 a point, ``id << 16 | raw class``. Where a log does
not number its scans, the token stands for the number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Scan, Scene
from l3ps.errors import LabelError, Problem
from l3ps.labels import confidence
from l3ps.labels.files import file_stem, folder_name, write_whole
from l3ps.labels.numbering import fitted_instances
from l3ps.labels.spaces import instances_in
from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import (
    NUSCENES16,
    NUSCENES16_TO_SEMANTICKITTI19,
    NUSCENES16_TO_SEMANTICKITTI_RAW,
    SEMANTICKITTI19,
    semantickitti_raw_lut,
    semantickitti_raw_to_nuscenes16_lut,
)

SUFFIX = ".label"
MAX_INSTANCE = (1 << 16) - 1


def write(out: Path, scene: Scene, labels: Sequence[ScanLabels]) -> list[Path]:
    """Write a scene's label files.

    Classes become their nearest raw id; trailer and construction vehicle share one (other-vehicle), so reading the
    files back does not tell them apart. A thing that becomes stuff (barrier → fence) loses its ids.

    Args:
        out: folder that gets ``sequences/``.
        scene: the scene; names the sequence folder.
        labels: the scene's scans in order.

    Returns:
        The files written, one a scan, or two where the labels have confidences.

    Raises:
        LabelError: over 65,535 instances of one class in the scene, or a token that cannot be a file name.
    """
    raw = np.asarray(NUSCENES16_TO_SEMANTICKITTI_RAW, dtype=np.uint32)
    # Numbered per class of the 19: that and the id are what the official evaluation takes for one segment.
    evaluated = np.asarray(NUSCENES16_TO_SEMANTICKITTI19)
    becomes_stuff = evaluated > max(SEMANTICKITTI19.things)
    instances = fitted_instances(scene.name, labels, evaluated, MAX_INSTANCE, NUSCENES16.is_thing & ~becomes_stuff)
    sequence = out / "sequences" / folder_name(scene.name)
    names = {scan.token: file_name(scan) for scan in scene.scans}
    written = []
    for scan, ids in zip(labels, instances, strict=True):
        values = raw[scan.semantic] | ids.astype(np.uint32) << 16
        name = names[scan.token]
        written.append(write_whole(sequence / "predictions" / name, values.astype("<u4").tobytes()))
        written += confidence.write(sequence, name.removesuffix(SUFFIX), scan)
    return written


def file_name(scan: Scan) -> str:
    """Name of a scan's label file.

    Raises:
        LabelError: the scan's number or token cannot be a file name.
    """
    return f"{file_stem(scan.number or scan.token)}{SUFFIX}"


def read(path: Path, space: str) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Classes and ids of one label file.

    Args:
        path: the file.
        space: ``semantickitti`` for the 19 classes, ``nuscenes`` for the 16.

    Returns:
        (N,) uint8 class in that space and (N,) int64 id, 0 = none, unique within a class.

    Raises:
        LabelError: the file cannot be read or its size is no multiple of 4 bytes.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise _bad(path, "cannot be read") from error
    if len(content) % 4:
        raise _bad(path, f"has {len(content):,} bytes, not a multiple of 4")
    values = np.frombuffer(content, dtype="<u4")
    raw, instance = values & 0xFFFF, values >> 16
    if space == SEMANTICKITTI19.name:
        # The official evaluation keys a segment by (class, id), so raw 10 and 252 (moving car) with one id are one car.
        return _lut(space)[raw], instance.astype(np.int64)
    semantic = _lut(space)[raw]
    return semantic, instances_in(semantic, _lut(SEMANTICKITTI19.name)[raw], instance, NUSCENES16)


@cache
def _lut(space: str) -> NDArray[np.uint8]:
    return semantickitti_raw_lut() if space == SEMANTICKITTI19.name else semantickitti_raw_to_nuscenes16_lut()


def _bad(path: Path, what: str) -> LabelError:
    return LabelError(
        Problem(code="unreadable-labels", where=str(path), what=what, remedy="Write the label file again.")
    )
