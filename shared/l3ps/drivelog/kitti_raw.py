"""KITTI raw, synced and rectified: ``DATE/DATE_drive_NNNN_sync/{velodyne_points,image_0N}`` and the day's calibration.

A pixel of camera N is P_rect_0N · R_rect_00 · (R | T)_velo_to_cam · x (Geiger et al. 2013). The vehicle's poses (oxts)
are not read: scan and images are triggered together, so projection needs none, and the method estimates its own.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import DriveLogError, Problem
from ..geometry import Matrix, orthonormal, transform
from . import kitti
from .names import is_file_name
from .points import COLUMNS, read_points, relative
from .types import CameraFrame, Drive, Scan, Scene

_COLOUR: Final = ("02", "03")
_GREY: Final = ("00", "01")
_PERIOD: Final = 100_000
"""Microseconds between scans where a drive has no time stamps: the Velodyne turned at 10 Hz."""

Camera = tuple[str, Matrix, Matrix, tuple[int, int] | None]
"""Number, intrinsic, camera_to_lidar, (width, height)."""


def open_kitti_raw(root: Path, drives: list[Path]) -> Drive:
    """Open drives of a KITTI raw log; each becomes a scene.

    Args:
        root: the log, for messages.
        drives: the folders that hold ``velodyne_points``; calibration files lie in their parent or beside the data.

    Returns:
        The drive; what could not be resolved is in its ``problems``.

    Raises:
        DriveLogError: no drive is left that has scans and calibration.
    """
    problems: list[Problem] = []
    scenes = []
    calibrations: dict[Path, list[Camera] | None] = {}
    for folder in drives:
        where = relative(folder, root)
        if not is_file_name(folder.name):
            problems.append(Problem("bad-name", where, "the folder's name has odd characters", "Rename the folder"))
            continue
        home = folder if (folder / "calib_velo_to_cam.txt").is_file() else folder.parent
        if home not in calibrations:
            calibrations[home] = _read_cameras(home, root, problems)
        cameras = calibrations[home]
        scans = _scans(folder, root, cameras or [], problems)
        if not scans:
            what = "the drive has no scan in velodyne_points/data"
            problems.append(Problem("no-scans", where, what, "Add NNNNNNNNNN.bin files", scene=folder.name))
        elif cameras is not None:
            scenes.append(Scene(folder.name, tuple(scans)))
    if not scenes:
        raise DriveLogError(problems)
    return Drive(root, "kitti-raw", tuple(scenes), "semantickitti", kitti.SENSOR_HEIGHT, tuple(problems))


def _read_cameras(folder: Path, root: Path, problems: list[Problem]) -> list[Camera] | None:
    """The cameras of a day, or None (and the problems) when the calibration cannot be used."""
    found = []
    for name in ("calib_velo_to_cam.txt", "calib_cam_to_cam.txt"):
        try:
            found.append(kitti.read_calibration(folder / name, root))
        except kitti.TextError as error:
            problems.append(error.problem)
    if len(found) < 2:
        return None
    velo, cams = found
    try:
        lidar_to_camera = kitti.rigid(_beside(velo["R"], velo["T"]))
    except (KeyError, ValueError) as error:
        problems.append(_bad(folder / "calib_velo_to_cam.txt", root, f"R or T is no rigid transform ({error})"))
        return None
    where = folder / "calib_cam_to_cam.txt"
    try:
        rotation = np.asarray(cams["R_rect_00"], dtype=np.float64).reshape(3, 3)
        transform(rotation, np.zeros(3))
        rectify = transform(orthonormal(rotation), np.zeros(3))
    except (KeyError, ValueError) as error:
        problems.append(_bad(where, root, f"R_rect_00 is no rotation ({error})"))
        return None
    cameras: list[Camera] = []
    for number in (*_COLOUR, *_GREY):
        if f"P_rect_{number}" not in cams:
            continue
        try:
            intrinsic, offset = kitti.split_projection(cams[f"P_rect_{number}"])
        except ValueError as error:
            problems.append(_bad(where, root, f"P_rect_{number} is no projection matrix: {error}"))
            continue
        size = cams.get(f"S_rect_{number}", [])
        sound = len(size) == 2 and all(0 < value < 1 << 16 for value in size)
        shape = (int(size[0]), int(size[1])) if sound else None
        cameras.append((number, intrinsic, kitti.camera_to_lidar(rectify @ lidar_to_camera, offset), shape))
    if not cameras:
        problems.append(_bad(where, root, "no camera has a usable P_rect"))
        return None
    return cameras


def _beside(rotation: list[float], translation: list[float]) -> list[float]:
    """Twelve numbers of (R | T), row by row."""
    if len(rotation) != 9 or len(translation) != 3:
        raise ValueError(f"{len(rotation)} and {len(translation)} numbers instead of 9 and 3")
    return [v for i in range(3) for v in (*rotation[3 * i : 3 * i + 3], translation[i])]


def _bad(path: Path, root: Path, what: str) -> Problem:
    return Problem("bad-calibration", relative(path, root), what, "Use the calibration files of that day's recording")


def _scans(folder: Path, root: Path, cameras: list[Camera], problems: list[Problem]) -> list[Scan]:
    files = kitti.numbered_files(folder / "velodyne_points" / "data", (".bin",))
    if not files:
        return []
    stamps = _stamps(folder / "velodyne_points", files, root, folder.name, problems)
    images: dict[str, tuple[dict[int, Path], dict[int, int]]] = {}
    with_images: list[str] = []
    for number, *_ in cameras:
        shots = kitti.numbered_files(folder / f"image_{number}" / "data", kitti.IMAGES)
        if shots and not (number in _GREY and with_images):  # grey shows nothing that colour does not
            with_images.append(number)
            images[number] = shots, _stamps(folder / f"image_{number}", shots, root, folder.name, problems)
    scans = []
    for index, (frame, path) in enumerate(files.items()):
        matched = [
            CameraFrame(
                channel=f"image_{number}",
                path=images[number][0][frame],
                timestamp=images[number][1][frame],
                size=size,
                intrinsic=intrinsic,
                camera_to_ego=pose,
            )
            for number, intrinsic, pose, size in cameras
            if number in images and frame in images[number][0]
        ]
        scans.append(
            Scan(
                token=f"{folder.name}_{path.stem}",
                index=index,
                timestamp=stamps[frame],
                path=path,
                lidar_to_ego=np.eye(4),
                ego_to_world=None,
                cameras=tuple(matched),
                load_points=partial(read_points, path, root, COLUMNS["kitti-raw"]),
                number=path.stem,
            )
        )
    return scans


def _stamps(folder: Path, files: dict[int, Path], root: Path, scene: str, problems: list[Problem]) -> dict[int, int]:
    """Time stamp of each numbered file: line n of ``timestamps.txt`` belongs to file n, even where some are missing."""
    path = folder / "timestamps.txt"
    try:
        lines = kitti.read_dates(path, root)
    except kitti.TextError as error:
        lines = []
        what = f"{error.problem.what}; 10 Hz is assumed"
        remedy = error.problem.remedy
        problems.append(Problem("bad-timestamps", error.problem.where, what, remedy, "warning", scene))
    else:
        short = [frame for frame in files if frame >= len(lines)]
        if short:
            what = (
                f"it has {len(lines)} lines, but file number {short[-1]} needs line {short[-1] + 1}; 10 Hz is assumed"
            )
            remedy = "Add the file with one line for every recorded frame"
            problems.append(Problem("bad-timestamps", relative(path, root), what, remedy, "warning", scene))
            lines = []
    return {frame: lines[frame] if lines else frame * _PERIOD for frame in files}
