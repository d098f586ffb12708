"""Where the LiDAR was at each scan, in the text format of KITTI odometry.

``poses.txt`` has one row a scan: the 12 numbers of the upper three rows of the transform lidar → scene, row by row,
metres, the scene's frame being that of its first scan. ``scans.txt`` names scene and token in the same order,
with a tab between, as either may contain spaces.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Scene
from l3ps.errors import LabelError, Problem
from l3ps.labels.files import write_whole

POSES = "poses.txt"
SCANS = "scans.txt"


def write_poses(out: Path, scenes_with_poses: Iterable[tuple[Scene, NDArray[np.float64]]]) -> list[Path]:
    """Write ``poses.txt`` and ``scans.txt`` for the scenes of a drive.

    Args:
        out: the folder.
        scenes_with_poses: each scene with its (S, 4, 4) float64 transforms lidar → scene, metres, one a scan.

    Returns:
        The two files.

    Raises:
        ValueError: a scene has another number of poses than scans, or a pose is not finite.
    """
    rows: list[str] = []
    names: list[str] = []
    for scene, poses in scenes_with_poses:
        if poses.shape != (len(scene.scans), 4, 4) or not np.isfinite(poses).all():
            raise ValueError(
                f"scene {scene.name}: {len(scene.scans)} scans need finite (S, 4, 4) poses, got {poses.shape}"
            )
        for scan, pose in zip(scene.scans, poses, strict=True):
            rows.append(" ".join(f"{value:.12g}" for value in pose[:3].ravel()))
            names.append(f"{scene.name}\t{scan.token}")
    return [
        write_whole(out / POSES, "".join(f"{row}\n" for row in rows).encode()),
        write_whole(out / SCANS, "".join(f"{name}\n" for name in names).encode()),
    ]


def read_poses(out: Path) -> dict[str, NDArray[np.float64]]:
    """The poses that :func:`write_poses` wrote.

    Returns:
        Scan token → (4, 4) float64 transform lidar → scene, metres.

    Raises:
        LabelError: a file is missing, or the two do not belong together.
    """
    try:
        rows = (out / POSES).read_text().splitlines()
        names = (out / SCANS).read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise _bad(out, "cannot be read") from error
    if len(rows) != len(names):
        raise _bad(out, f"has {len(rows)} rows where {SCANS} has {len(names)}")
    poses: dict[str, NDArray[np.float64]] = {}
    for number, (row, name) in enumerate(zip(rows, names, strict=True), 1):
        try:
            upper = np.asarray([float(value) for value in row.split()], dtype=np.float64).reshape(3, 4)
        except ValueError as error:
            raise _bad(out, f"has no 12 numbers in row {number}") from error
        poses[name.rpartition("\t")[2]] = np.vstack((upper, (0.0, 0.0, 0.0, 1.0)))
    return poses


def _bad(out: Path, what: str) -> LabelError:
    return LabelError(
        Problem(
            code="unreadable-poses",
            where=str(out / POSES),
            what=what,
            remedy=f"Give the folder that holds {POSES} and {SCANS} as `l3ps label` wrote them.",
        )
    )
