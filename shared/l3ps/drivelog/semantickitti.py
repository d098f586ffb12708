"""SemanticKITTI and plain KITTI odometry: ``sequences/NN/{velodyne,image_N,labels,calib.txt,poses.txt,times.txt}``.

``calib.txt`` holds P0–P3 of the rectified cameras and Tr (LiDAR → camera 0), ``poses.txt`` poses of camera 0. A label
is 32 bits: class in the low half, instance in the high half (Behley et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import DriveLogError, Problem
from ..geometry import Matrix
from ..taxonomy import SEMANTICKITTI19, semantickitti_raw_lut
from . import kitti
from .names import is_file_name
from .nuscenes_truth import bad_truth, truth_length, wrong_length
from .points import COLUMNS, missing_file, read_points, relative
from .types import CameraFrame, Drive, Scan, Scene, Truth

_PERIOD: Final = 100_000
"""Microseconds between scans where a sequence has no times.txt."""
_CALIB: Final = "Use the calib.txt of this sequence, with P0 to P3 and Tr"
_POSES: Final = "Add the poses of all scans, or remove the file"
_TIMES: Final = "Add one line for every scan, or remove the file"


@dataclass(frozen=True)
class LabelFiles:
    """All label files of a log, which tell together whether it has instances."""

    paths: tuple[Path, ...]

    @cached_property
    def has_instances(self) -> bool:
        """Whether any label of the log names an instance; reads until the first one."""
        return any(bool(_read_words(path)[1::2].any()) for path in self.paths)


def _read_words(path: Path) -> NDArray[np.uint16]:
    """The 16-bit words of a label file: classes at even places, instances at odd ones; empty when unreadable."""
    try:
        words = np.fromfile(path, dtype="<u2")
    except OSError:
        return np.zeros(0, dtype=np.uint16)
    return words[: len(words) // 2 * 2]


def read_truth(path: Path, scan: Path, root: Path, files: LabelFiles) -> Truth:
    """The truth of one scan in the 19 classes.

    Instance ids are those of the file; stuff and void have none.

    Args:
        path: the ``.label`` file.
        scan: the point file it belongs to, which sets the length.
        root: the log, for messages.
        files: the log's label files.

    Raises:
        DriveLogError: missing, or not one label a point.
    """
    where = relative(path, root)
    try:
        points = scan.stat().st_size // (4 * COLUMNS["semantickitti"])
    except OSError as error:
        raise DriveLogError(missing_file(relative(scan, root), "scan file")) from error
    try:
        length = truth_length(path)
    except ValueError as error:
        raise DriveLogError(bad_truth(where, str(error))) from error
    except OSError as error:
        raise DriveLogError(missing_file(where, "truth file")) from error
    if length != points:
        raise DriveLogError(wrong_length(where, length, points))
    words = _read_words(path)
    semantic = semantickitti_raw_lut()[words[0::2]]
    instance = np.where(SEMANTICKITTI19.is_thing[semantic], words[1::2], 0).astype(np.int32)
    return Truth(semantic, instance, has_instances=bool(instance.any()) or files.has_instances)


def open_semantickitti(root: Path, sequences: list[Path]) -> Drive:
    """Open sequences; each becomes a scene.

    Args:
        root: the log, for messages.
        sequences: the folders that hold ``velodyne``.

    Returns:
        The drive; what could not be resolved is in its ``problems``.

    Raises:
        DriveLogError: no sequence is left that has scans and calibration.
    """
    problems: list[Problem] = []
    labels = [kitti.numbered_files(folder / "labels", (".label",)) for folder in sequences]
    files = LabelFiles(tuple(path for found in labels for path in found.values()))
    scenes = []
    for folder, truth in zip(sequences, labels, strict=True):
        where = relative(folder, root)
        if not is_file_name(folder.name):
            problems.append(Problem("bad-name", where, "the folder's name has odd characters", "Rename the folder"))
            continue
        calibration = _read_cameras(folder / "calib.txt", root, folder.name, problems)
        points = kitti.numbered_files(folder / "velodyne", (".bin",))
        if not points:
            what = "the sequence has no scan in velodyne"
            problems.append(Problem("no-scans", where, what, "Add NNNNNN.bin files", scene=folder.name))
        if points and calibration is not None:
            scenes.append(_Sequence(folder, root, points, *calibration, problems).scene(truth, files))
    if not scenes:
        raise DriveLogError(problems)
    return Drive(root, "semantickitti", tuple(scenes), "semantickitti", kitti.SENSOR_HEIGHT, tuple(problems))


def _read_cameras(
    path: Path, root: Path, scene: str, problems: list[Problem]
) -> tuple[Matrix, dict[int, tuple[Matrix, Matrix]]] | None:
    """lidar → camera 0, and number → (intrinsic, camera_to_lidar); None (and the problem) when Tr cannot be used."""
    try:
        values = kitti.read_calibration(path, root)
    except kitti.TextError as error:
        p = error.problem
        problems.append(Problem(p.code, p.where, p.what, p.remedy, scene=scene))
        return None
    where = relative(path, root)
    try:
        lidar_to_camera = kitti.rigid(values["Tr"] if "Tr" in values else values["Tr_velo_to_cam"])
    except KeyError:
        problems.append(Problem("missing-calibration", where, "it has no Tr (LiDAR to camera 0)", _CALIB, scene=scene))
        return None
    except ValueError as error:
        problems.append(Problem("bad-calibration", where, f"Tr is no rigid transform: {error}", _CALIB, scene=scene))
        return None
    cameras = {}
    for number in range(4):
        if f"P{number}" not in values:
            continue
        try:
            intrinsic, offset = kitti.split_projection(values[f"P{number}"])
        except ValueError as error:
            what = f"P{number} is no projection matrix: {error}"
            problems.append(Problem("bad-calibration", where, what, _CALIB, scene=scene))
            continue
        cameras[number] = intrinsic, kitti.camera_to_lidar(lidar_to_camera, offset)
    return lidar_to_camera, cameras


@dataclass(frozen=True, slots=True)
class _Sequence:
    """One sequence while its scene is put together."""

    folder: Path
    root: Path
    points: dict[int, Path]
    lidar_to_camera: Matrix
    cameras: dict[int, tuple[Matrix, Matrix]]
    problems: list[Problem]

    def scene(self, truth: dict[int, Path], files: LabelFiles) -> Scene:
        """The scene; ``truth`` are this sequence's label files by number, ``files`` those of the whole log."""
        poses, times, images = self._poses(), self._times(), self._images()
        scans = []
        for index, (frame, path) in enumerate(self.points.items()):
            label = truth.get(frame)
            cameras = tuple(
                CameraFrame(
                    channel=f"image_{number}",
                    path=shots[frame],
                    timestamp=times[frame],
                    size=None,
                    intrinsic=self.cameras[number][0],
                    camera_to_ego=self.cameras[number][1],
                    ego_to_world=poses.get(frame),
                )
                for number, shots in images.items()
                if frame in shots
            )
            scans.append(
                Scan(
                    token=f"{self.folder.name}_{path.stem}",
                    index=index,
                    timestamp=times[frame],
                    path=path,
                    lidar_to_ego=np.eye(4),
                    ego_to_world=poses.get(frame),
                    cameras=cameras,
                    load_points=partial(read_points, path, self.root, COLUMNS["semantickitti"]),
                    load_truth=None if label is None else partial(read_truth, label, path, self.root, files),
                    number=path.stem,
                    truth_path=label,
                )
            )
        return Scene(self.folder.name, tuple(scans))

    def _report(self, code: str, where: str, what: str, remedy: str, *, warn: bool = True) -> None:
        severity: Literal["warning", "error"] = "warning" if warn else "error"
        self.problems.append(Problem(code, where, what, remedy, severity, self.folder.name))

    def _images(self) -> dict[int, dict[int, Path]]:
        """camera number → frame → image: the colour cameras 2 and 3, or the grey 0 and 1 where there is no colour."""
        images = {}
        for number in range(4):
            shots = kitti.numbered_files(self.folder / f"image_{number}", kitti.IMAGES)
            if shots and number in self.cameras:
                images[number] = shots
            elif shots:
                where = relative(self.folder / "calib.txt", self.root)
                what = f"it has no usable P{number}, but the sequence has images of camera {number}"
                self._report("missing-calibration", where, what, _CALIB, warn=False)
        colour = {number: shots for number, shots in images.items() if number >= 2}
        return colour or images

    def _poses(self) -> dict[int, Matrix]:
        """Poses by scan number; none at all when the file is absent or unsound, since nothing depends on them."""
        path = self.folder / "poses.txt"
        if not path.is_file():
            return {}
        try:
            poses = kitti.to_lidar_poses(kitti.read_poses(path, self.root), self.lidar_to_camera)
        except kitti.TextError as error:
            self._report("bad-pose", error.problem.where, f"{error.problem.what}; no pose is used", _POSES)
            return {}
        last = max(self.points)
        if last >= len(poses):
            what = f"it has {len(poses)} poses, but scan number {last} needs line {last + 1}; no pose is used"
            self._report("bad-pose", relative(path, self.root), what, _POSES)
            return {}
        return {frame: poses[frame] for frame in self.points}

    def _times(self) -> dict[int, int]:
        """Time stamps by scan number, microseconds."""
        path = self.folder / "times.txt"
        lines: list[int] = []
        if path.is_file():
            try:
                lines = kitti.read_seconds(path, self.root)
            except kitti.TextError as error:
                self._report("bad-timestamps", error.problem.where, f"{error.problem.what}; 10 Hz is assumed", _TIMES)
            last = max(self.points)
            if lines and last >= len(lines):
                what = f"it has {len(lines)} lines, but scan number {last} needs line {last + 1}; 10 Hz is assumed"
                self._report("bad-timestamps", relative(path, self.root), what, _TIMES)
                lines = []
        return {frame: lines[frame] if lines else frame * _PERIOD for frame in self.points}
