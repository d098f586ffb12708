"""Point files: rows of little-endian float32, five columns in nuScenes, four in KITTI."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import DriveLogError, Problem
from .types import LogFormat, Points

COLUMNS: Final[dict[LogFormat, int]] = {"nuscenes": 5, "kitti-raw": 4, "semantickitti": 4}
"""Columns of a point file by format: x, y, z, intensity, and the ring in nuScenes.

A nuScenes file is never taken for one of four columns, even if its size would allow it: one in four truncated files
has such a size, and would be read as nonsense without a word.
"""

LARGEST_SCAN: Final = 1 << 28
"""Bytes; thirteen million points. A larger file is no scan, and is not read into memory to find out."""

FULL_INTENSITY: Final = 255.0
"""nuScenes stores intensity as 0..255; KITTI as 0..1."""


def relative(path: Path, root: Path) -> str:
    """A path as messages show it: relative to the log where it lies inside."""
    try:
        return path.relative_to(root).as_posix()
    except ValueError:
        return str(path)


def size_problem(where: str, size: int, columns: int) -> Problem | None:
    """The problem with a point file of ``size`` bytes, or None when it holds whole rows."""
    row = columns * 4
    if size > LARGEST_SCAN:
        what = f"the scan has {size} bytes, more than the {LARGEST_SCAN} that one turn of a LiDAR can need"
        remedy = "Write one file for each turn of the LiDAR, or leave this scan out"
        return Problem("oversized-scan", where, what, remedy, "scan")
    if size and size % row == 0:
        return None
    return Problem(
        code="truncated-scan",
        where=where,
        what=f"the scan has {size} bytes, which is not one or more whole points of {row} bytes"
        if size
        else "the scan file is empty",
        remedy="Copy the file again from the recording, or leave this scan out",
        severity="scan",
    )


def missing_file(where: str, kind: str) -> Problem:
    """The problem of a file that the log names and does not have."""
    return Problem(
        code="missing-file",
        where=where,
        what=f"the {kind} is missing",
        remedy="Add the file to the log, or leave this scan out",
        severity="scan",
    )


def read_rows(path: Path, root: Path, columns: int) -> NDArray[np.float32]:
    """All rows of a point file.

    Args:
        path: the file.
        root: the log, for the message.
        columns: float32 values a point.

    Returns:
        (N, columns) float32.

    Raises:
        DriveLogError: missing, empty or not a whole number of rows.
    """
    where = relative(path, root)
    try:
        problem = size_problem(where, path.stat().st_size, columns)
        if problem is None:
            return np.fromfile(path, dtype="<f4").reshape(-1, columns)
    except (OSError, ValueError) as error:
        raise DriveLogError(missing_file(where, "scan file")) from error
    raise DriveLogError(problem)


def read_points(path: Path, root: Path, columns: int) -> Points:
    """The points of one scan.

    Intensity is brought to 0..1; values that are no number there become 0, because nothing depends on them. Coordinates
    are passed on as they are.

    Args:
        path: the point file.
        root: the log, for messages.
        columns: 5 for nuScenes, 4 for KITTI.

    Raises:
        DriveLogError: missing, truncated, or a coordinate that is not a finite number.
    """
    rows = read_rows(path, root, columns)
    xyz = np.ascontiguousarray(rows[:, :3])
    if not np.isfinite(xyz).all():
        raise DriveLogError(non_finite(relative(path, root), int((~np.isfinite(xyz).all(axis=1)).sum()), len(xyz)))
    intensity = rows[:, 3] / FULL_INTENSITY if columns == COLUMNS["nuscenes"] else rows[:, 3]
    intensity = np.clip(np.nan_to_num(intensity, nan=0.0), 0.0, 1.0).astype(np.float32)
    ring = None
    if columns > 4:
        beam = np.nan_to_num(rows[:, 4], nan=0.0, posinf=0.0, neginf=0.0).clip(0, np.iinfo(np.uint16).max)
        # A log whose writer had no beam index fills the column with zeros.
        ring = beam.astype(np.uint16) if beam.any() else None
    return Points(xyz=xyz, intensity=intensity, ring=ring)


def non_finite(where: str, bad: int, total: int) -> Problem:
    """The problem of points whose coordinates are NaN or infinite."""
    return Problem(
        code="non-finite-points",
        where=where,
        what=f"{bad} of {total} points ({100 * bad / max(total, 1):.1f} %) have a coordinate that is NaN or infinite",
        remedy="Write the scan without returns that have no range, or leave this scan out",
        severity="scan",
    )


def read_intrinsic(values: object) -> NDArray[np.float64]:
    """A pinhole matrix from a table or file.

    Args:
        values: (3, 3) numbers, pixels.

    Returns:
        (3, 3) float64.

    Raises:
        ValueError: not a finite pinhole matrix with positive focal lengths.
    """
    matrix = np.asarray(values, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ValueError("the intrinsic matrix is not 3x3 finite numbers")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
        raise ValueError("the intrinsic matrix has no positive focal lengths or its last row is not 0 0 1")
    return matrix
