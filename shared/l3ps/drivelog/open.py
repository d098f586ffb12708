"""Opening a log: find which layout a folder has, and hand it to the reader."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from ..errors import DriveLogError, Problem
from .kitti_raw import open_kitti_raw
from .names import is_hidden, subfolders
from .nuscenes import open_nuscenes
from .semantickitti import open_semantickitti
from .types import Drive
from .validate import validate, without_bad_scans

LOOKED_FOR: Final = "v1.0-*/scene.json, */velodyne_points, sequences/*/velodyne"
_NESTING: Final = 3
"""Folders an archive may wrap around the log."""


def open_drive(path: Path, *, sweeps: bool = False, skip_bad_scans: bool = False) -> Drive:
    """Open a drive log.

    Args:
        path: the folder of the log, a folder around it that holds no other folder, one of its ``v1.0-*`` folders
            (to choose among several), a KITTI day or drive, or one sequence.
        sweeps: nuScenes only: also yield the sweeps between keyframes.
        skip_bad_scans: validate the log and leave out the scans and scenes that have problems.

    Returns:
        The drive. Without ``skip_bad_scans`` the scans are found, not read: :func:`l3ps.drivelog.validate` looks at
        every file.

    Raises:
        DriveLogError: no log there, or one whose tables or calibration cannot be used; with all problems found.
    """
    drive = _find(path, sweeps)
    return without_bad_scans(drive, validate(drive)) if skip_bad_scans else drive


def _find(path: Path, sweeps: bool) -> Drive:
    if not path.is_dir():
        what = "it is a file, not a folder" if path.exists() else "there is no such file or folder"
        raise DriveLogError(Problem("no-log", str(path), what, "Name a drive log: its folder or an archive of it"))
    folder = path.resolve()
    for _ in range(_NESTING + 1):
        drive = _open_here(folder, sweeps)
        if drive is not None:
            return drive
        inner = subfolders(folder)
        if len(inner) != 1:
            break
        folder = inner[0]
    raise DriveLogError(
        Problem(
            "no-log",
            path.name or str(path),
            f"no LiDAR log found: looked for {LOOKED_FOR}",
            "Use a log in nuScenes, KITTI raw or SemanticKITTI layout",
        )
    )


def _open_here(folder: Path, sweeps: bool) -> Drive | None:
    """The log in exactly this folder, or None."""
    if folder.name.startswith("v1.0-") and _has_tables(folder):
        return open_nuscenes(folder.parent, folder, sweeps=sweeps)
    versions = [p for p in subfolders(folder) if p.name.startswith("v1.0-") and _has_tables(p)]
    if len(versions) > 1:
        names = ", ".join(p.name for p in versions)
        what = f"the log has {len(versions)} sets of tables ({names})"
        raise DriveLogError(Problem("several-logs", folder.name, what, "Name one of these folders instead"))
    if versions:
        return open_nuscenes(folder, versions[0], sweeps=sweeps)
    for sequences in (folder / "sequences", folder):
        found = [p for p in subfolders(sequences) if (p / "velodyne").is_dir()]
        if found:
            return open_semantickitti(folder, found)
    if (folder / "velodyne").is_dir():
        return open_semantickitti(folder.parent, [folder])
    for pattern in ("velodyne_points", "*/velodyne_points", "*/*/velodyne_points"):
        drives = sorted(p.parent for p in folder.glob(pattern) if p.is_dir() and not _hidden_between(folder, p))
        if drives:
            return open_kitti_raw(folder, drives)
    return None


def _has_tables(folder: Path) -> bool:
    return any((folder / f"{name}.json").is_file() for name in ("scene", "sample", "sample_data"))


def _hidden_between(folder: Path, path: Path) -> bool:
    return any(is_hidden(Path(part)) for part in path.relative_to(folder).parts)
