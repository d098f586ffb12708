"""What KITTI raw and KITTI odometry share: key/number files, projection matrices, numbered files, time stamps."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import Problem
from ..geometry import Matrix, invert, orthonormal, transform
from .names import is_hidden
from .points import read_intrinsic, relative

SENSOR_HEIGHT: Final = 1.73
"""Metres of the Velodyne above ground (Geiger et al. 2013, fig. 3)."""

IMAGES: Final = (".png", ".jpg", ".jpeg")
_LONGEST_TEXT: Final = 1 << 26
"""Bytes of a text file that are read at all; the longest real one, poses of 4,541 scans, has 0.9 MB."""

_ENDLESS: Final = 1 << 62
"""Microseconds: 146,000 years. Times beyond it do not fit the integers that the rest of the way counts in."""


class TextError(ValueError):
    """A text file cannot be used; carries the problem."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(str(problem))
        self.problem = problem


def read_text(path: Path, root: Path, kind: str) -> str:
    """A text file of the log.

    Raises:
        TextError: missing, too large or not text.
    """
    where = relative(path, root)
    try:
        if path.stat().st_size > _LONGEST_TEXT:
            raise TextError(Problem("bad-text", where, f"the {kind} is too large", f"Add a sound {kind}"))
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TextError(Problem("missing-" + kind, where, f"the {kind} file is missing", f"Add {where}")) from error
    except UnicodeDecodeError as error:
        raise TextError(
            Problem("bad-" + kind, where, f"the {kind} file is not text", f"Add a sound {where}")
        ) from error


def read_calibration(path: Path, root: Path) -> dict[str, list[float]]:
    """Lines ``key: number number …``; lines whose values are no numbers (dates) are left out.

    Raises:
        TextError: the file is missing or not text.
    """
    values: dict[str, list[float]] = {}
    for line in read_text(path, root, "calibration").splitlines():
        key, _, numbers = line.partition(":")
        try:
            values[key.strip()] = [float(n) for n in numbers.split()]
        except ValueError:
            continue
    return values


def rigid(values: list[float]) -> Matrix:
    """A (4, 4) transform from twelve numbers, row by row.

    Raises:
        ValueError: not twelve finite numbers or no rotation.
    """
    if len(values) != 12:
        raise ValueError(f"it has {len(values)} numbers instead of 12")
    rows = np.asarray(values, dtype=np.float64).reshape(3, 4)
    checked = transform(rows[:, :3], rows[:, 3])
    return transform(orthonormal(checked[:3, :3]), checked[:3, 3])


def split_projection(values: list[float]) -> tuple[Matrix, Matrix]:
    """Take a rectified projection P = K [I | t] apart.

    KITTI gives each camera's offset from camera 0 as the fourth column of P; a pinhole model wants it in the pose.

    Args:
        values: twelve numbers, row by row.

    Returns:
        The (3, 3) intrinsic K, and the (4, 4) transform rectified camera 0 → this camera.

    Raises:
        ValueError: not a projection of a rectified camera.
    """
    if len(values) != 12:
        raise ValueError(f"it has {len(values)} numbers instead of 12")
    rows = np.asarray(values, dtype=np.float64).reshape(3, 4)
    intrinsic = read_intrinsic(rows[:, :3])
    return intrinsic, transform(np.eye(3), np.linalg.solve(intrinsic, rows[:, 3]))


def camera_to_lidar(lidar_to_rectified: Matrix, rectified_to_camera: Matrix) -> Matrix:
    """Pose of a camera in the LiDAR's frame, which serves as the ego frame of a KITTI log."""
    return invert(rectified_to_camera @ lidar_to_rectified)


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files whose name is a number, by that number and in its order; other files are left alone."""
    files: dict[int, Path] = {}
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return {}
    for path in entries:
        if path.suffix.lower() in suffixes and re.fullmatch(r"[0-9]{1,18}", path.stem) and not is_hidden(path):
            files.setdefault(int(path.stem), path)
    return dict(sorted(files.items()))


def read_dates(path: Path, root: Path) -> list[int]:
    """Microseconds since the epoch (as if the clock were UTC) from lines like ``2011-09-26 13:02:25.123456789``.

    Raises:
        TextError: missing, or a line that is no date.
    """
    stamps = []
    for number, line in enumerate(read_text(path, root, "timestamps").split("\n"), start=1):
        if not line.strip():
            continue
        try:
            date, _, fraction = line.strip().partition(".")
            seconds = int((datetime.fromisoformat(date) - datetime(1970, 1, 1)).total_seconds())
            stamps.append(seconds * 1_000_000 + int(fraction[:6].ljust(6, "0")))
        except (ValueError, TypeError) as error:
            raise TextError(_bad_line(path, root, number, "a date like 2011-09-26 13:02:25.123456789")) from error
    return stamps


def read_seconds(path: Path, root: Path) -> list[int]:
    """Microseconds from lines that hold seconds.

    Raises:
        TextError: missing, or a line that is no number, or not one that a clock shows.
    """
    stamps = []
    for number, line in enumerate(read_text(path, root, "timestamps").split("\n"), start=1):
        if not line.strip():
            continue
        try:
            stamps.append(round(float(line) * 1e6))
            if abs(stamps[-1]) >= _ENDLESS:
                raise ValueError("no clock shows this")
        except (ValueError, OverflowError) as error:
            raise TextError(_bad_line(path, root, number, "a number of seconds")) from error
    return stamps


def read_poses(path: Path, root: Path) -> list[Matrix]:
    """(4, 4) transforms from lines of twelve numbers.

    Raises:
        TextError: missing, or a line that is no rigid transform.
    """
    poses = []
    for number, line in enumerate(read_text(path, root, "poses").split("\n"), start=1):
        if not line.strip():
            continue
        try:
            poses.append(rigid([float(value) for value in line.split()]))
        except ValueError as error:
            raise TextError(_bad_line(path, root, number, "a rigid transform of twelve numbers")) from error
    return poses


def to_lidar_poses(camera_poses: list[Matrix], lidar_to_camera: Matrix) -> list[Matrix]:
    """Poses of the LiDAR in the frame of the first scan's LiDAR, from poses of camera 0 in the frame of its first."""
    inverse = invert(lidar_to_camera)
    return [inverse @ pose @ lidar_to_camera for pose in camera_poses]


def _bad_line(path: Path, root: Path, number: int, expected: str) -> Problem:
    where = f"{relative(path, root)}:{number}"
    return Problem("bad-text", where, f"the line is not {expected}", "Correct the line, or export the file again")
