"""Truth of nuScenes logs: lidarseg and panoptic files, brought from raw categories to the challenge classes."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Final, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import DriveLogError, Problem
from ..taxonomy import INSTANCE_FACTOR, NUSCENES16
from .points import COLUMNS, missing_file, relative
from .types import Truth

TruthKind = Literal["lidarseg", "panoptic"]

_ARRAY: Final = "data.npy"
_HEADER: Final = 512
"""Bytes allowed for the header of a .npy file beside its values."""


def truth_length(path: Path) -> int:
    """Number of labels in a truth file, from its size or header alone.

    Args:
        path: ``*.npz`` (panoptic), ``*.label`` (SemanticKITTI) or any other (lidarseg, one byte a point).

    Raises:
        ValueError: the file is no such file; the message says why.
        OSError: it cannot be read.
    """
    size = path.stat().st_size
    if path.suffix == ".label":
        if size % 4:
            raise ValueError(f"its {size} bytes are not whole labels of 4 bytes")
        return size // 4
    if path.suffix != ".npz":
        return size
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_ARRAY) as member:
            version = np.lib.format.read_magic(member)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(member)
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"it is no .npz file with an array 'data' ({error})") from error
    if len(shape) != 1 or dtype.kind not in "ui":
        raise ValueError(f"its array 'data' is {len(shape)}-dimensional {dtype}, not one integer a point")
    return int(shape[0])


def read_truth(path: Path, kind: TruthKind, lut: NDArray[np.uint8], scan: Path, root: Path) -> Truth:
    """The truth of one scan in the ``NUSCENES16`` space.

    The instance id of a thing is its whole raw panoptic value (raw category * 1000 + number): several raw categories
    become one class and count their instances each from 1, so the number alone would join two objects.

    Args:
        path: the truth file.
        kind: which file it is.
        lut: (256,) uint8, raw category index → class.
        scan: the point file it belongs to, which sets the length.
        root: the log, for messages.

    Raises:
        DriveLogError: missing, not readable, or not one label a point.
    """
    where = relative(path, root)
    try:
        points = scan.stat().st_size // (4 * COLUMNS["nuscenes"])
    except OSError as error:
        raise DriveLogError(missing_file(relative(scan, root), "scan file")) from error
    raw = _raw(path, kind, points, where)
    semantic = lut[np.minimum(raw // INSTANCE_FACTOR if kind == "panoptic" else raw, 255)]
    instance = np.zeros(points, dtype=np.int32)
    if kind == "panoptic":
        thing = NUSCENES16.is_thing[semantic] & (raw % INSTANCE_FACTOR > 0)
        instance[thing] = raw[thing]
    return Truth(semantic, instance, has_instances=kind == "panoptic")


def _raw(path: Path, kind: TruthKind, points: int, where: str) -> NDArray[np.int64]:
    try:
        length = truth_length(path)
        if length != points:
            raise DriveLogError(wrong_length(where, length, points))
        if kind == "lidarseg":
            return np.fromfile(path, dtype=np.uint8).astype(np.int64)
        with zipfile.ZipFile(path) as archive:
            # The size is bounded by the scan before anything is inflated: a .npz may be a bomb.
            if archive.getinfo(_ARRAY).file_size > points * 8 + _HEADER:
                raise ValueError("its array is larger than one integer a point")
        with np.load(path, allow_pickle=False) as arrays:
            return cast("NDArray[np.int64]", arrays["data"].astype(np.int64))
    except FileNotFoundError as error:
        raise DriveLogError(missing_file(where, "truth file")) from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DriveLogError(bad_truth(where, str(error))) from error


def wrong_length(where: str, labels: int, points: int) -> Problem:
    """The problem of a truth file that does not fit its scan."""
    return Problem(
        "truth-length",
        where,
        f"the truth has {labels} labels and the scan {points} points",
        "Copy scan and truth of the same recording and release, or leave this scan out",
        severity="scan",
    )


def bad_truth(where: str, why: str) -> Problem:
    """The problem of a truth file that cannot be read."""
    return Problem(
        "bad-truth",
        where,
        f"the truth cannot be read: {why}",
        "Copy the truth file again, or leave this scan out",
        severity="scan",
    )
