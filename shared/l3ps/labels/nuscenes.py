"""Panoptic nuScenes and nuScenes-lidarseg label files, in the index space of submissions (challenge classes).

``panoptic/<token>_panoptic.npz`` holds ``data``: uint16 ``class * 1000 + id``; ``lidarseg/<token>_lidarseg.bin`` holds
one uint8 class a point; for ``confidence/`` see :mod:`l3ps.labels.confidence`. (Truth of nuScenes itself has the raw
category in place of the class; see ``l3ps.drivelog``.)
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.errors import LabelError, Problem
from l3ps.labels import confidence
from l3ps.labels.files import file_stem, write_whole
from l3ps.labels.numbering import fitted_instances
from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import INSTANCE_FACTOR, NUSCENES16, pack, unpack

PANOPTIC_SUFFIX = "_panoptic.npz"
LIDARSEG_SUFFIX = "_lidarseg.bin"


def write(out: Path, scene: str, labels: Sequence[ScanLabels]) -> list[Path]:
    """Write a scene's panoptic and lidarseg files.

    Args:
        out: folder that gets ``panoptic/``, ``lidarseg/`` and, where labels have it, ``confidence/``.
        scene: the scene's name, for messages.
        labels: the scene's scans in order.

    Returns:
        The files written, two a scan or three.

    Raises:
        LabelError: over 999 instances of one class in the scene, or a token that cannot be a file name.
    """
    code = np.arange(len(NUSCENES16.classes))
    instances = fitted_instances(scene, labels, code, INSTANCE_FACTOR - 1, NUSCENES16.is_thing)
    written = []
    for scan, ids in zip(labels, instances, strict=True):
        stem = file_stem(scan.token)
        panoptic = BytesIO()
        np.savez_compressed(panoptic, data=pack(scan.semantic, ids).astype(np.uint16))
        written.append(write_whole(out / "panoptic" / f"{stem}{PANOPTIC_SUFFIX}", panoptic.getvalue()))
        written.append(write_whole(out / "lidarseg" / f"{stem}{LIDARSEG_SUFFIX}", scan.semantic.tobytes()))
        written += confidence.write(out, stem, scan)
    return written


def read_panoptic(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Classes and ids of one panoptic file.

    Returns:
        (N,) uint8 class and (N,) int32 id, 0 = none. An id is the file's whole value ``class * 1000 + i``: the file
        numbers each class from 1, and one id must not name two objects of a scan.

    Raises:
        LabelError: the file cannot be read, or its values are not ``class * 1000 + id`` of the 16 classes.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            panoptic = np.asarray(archive["data"])
    except KeyError as error:
        raise _bad(path, "has no array 'data'") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _bad(path, "is not a readable npz file") from error
    if panoptic.ndim != 1 or panoptic.dtype.kind not in "iu":
        raise _bad(path, f"holds {panoptic.dtype} of shape {panoptic.shape}, not one integer a point")
    _check_classes(path, panoptic, INSTANCE_FACTOR)
    semantic, instance = unpack(panoptic)
    return semantic, np.where(instance > 0, panoptic, 0).astype(np.int32)


def read_lidarseg(path: Path) -> NDArray[np.uint8]:
    """(N,) uint8 classes of one lidarseg file.

    Raises:
        LabelError: the file cannot be read, or holds a value above 16.
    """
    try:
        semantic = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise _bad(path, "cannot be read") from error
    _check_classes(path, semantic, 1)
    return semantic


def _check_classes(path: Path, values: NDArray[np.integer], factor: int) -> None:
    """LabelError unless every value is a challenge class times ``factor``, plus less than ``factor``."""
    if not values.size:
        return
    highest, lowest = int(values.max()), int(values.min())
    if lowest < 0 or highest // factor >= len(NUSCENES16.classes):
        value = lowest if lowest < 0 else highest
        raise LabelError(
            Problem(
                code="unknown-class",
                where=str(path),
                what=f"holds the value {value}, whose class {value // factor} is none of 0–16",
                remedy="Give predictions in challenge classes; truth in raw categories is read from the log itself.",
            )
        )


def _bad(path: Path, what: str) -> LabelError:
    return LabelError(
        Problem(code="unreadable-labels", where=str(path), what=what, remedy="Write the label file again.")
    )
