"""Pre-flight validation: everything wrong with a log, before any processor time goes into it.

Points are read, because only they tell NaN from numbers and a calibration that fits from one that does not; images are
looked at by header and end, truth by its length.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import DriveLogError, Problem
from ..geometry import apply
from ..progress import Progress, silent
from .images import BadImage, image_size
from .nuscenes_truth import bad_truth, truth_length, wrong_length
from .points import COLUMNS, missing_file, non_finite, read_rows, relative
from .types import CameraFrame, Drive, Scan, Scene

_FEWEST_POINTS: Final = 10
"""Fewer returns are no scan, whatever the sensor: odometry and ground fitting cannot work with them."""
_FARTHEST: Final = 10_000.0
"""Metres. No LiDAR sees so far; such values come from files of another column count, byte order or unit."""
_SAMPLE: Final = 4096
"""Points of a scan that are projected: a camera that sees a hundredth of the scan still gets forty of them."""
_NEAREST: Final = 1.0
"""Metres in front of a camera from which points are projected (METHOD: projection)."""


def validate(drive: Drive, progress: Progress = silent) -> list[Problem]:
    """All problems of a drive log.

    Args:
        drive: the opened log.
        progress: told the scans looked at (stage ``validate``); may raise to stop.

    Returns:
        The problems, those of the reader first, then scene by scene in scan order. Empty when the log is sound. A
        problem of severity ``error`` spoils its scene (without a scene: the log), ``scan`` one scan, ``warning``
        nothing.
    """
    problems = list(drive.problems)
    total = sum(len(scene.scans) for scene in drive.scenes)
    if not total:
        problems.append(Problem("no-scans", drive.root.name, "the log has no LiDAR scan", "Add the scans"))
    done = 0
    seen: dict[str, str] = {}
    for scene in drive.scenes:
        check = _SceneCheck(drive, scene)
        for scan in scene.scans:
            if seen.setdefault(scan.token, scene.name) != scene.name or scan.token in check.tokens:
                check.error("duplicate-token", scan.path, f"the scan token {scan.token} occurs twice", "Rename one")
            check.scan(scan)
            done += 1
            progress("validate", done, total)
        problems.extend(check.finish())
    return problems


def without_bad_scans(drive: Drive, problems: Iterable[Problem]) -> Drive:
    """What is left of a log without the scenes and scans that have problems.

    Args:
        drive: the log.
        problems: from :func:`validate`.

    Returns:
        The log with the good scans, numbered anew from 0 in each scene; its ``problems`` are the warnings.

    Raises:
        DriveLogError: a problem concerns the whole log, or no scan is left.
    """
    problems = list(problems)
    fatal = [p for p in problems if p.severity == "error" and p.scene is None]
    if fatal:
        raise DriveLogError(fatal)
    scenes = {p.scene for p in problems if p.severity == "error"}
    scans = {(p.scene, p.scan) for p in problems if p.severity == "scan"}
    kept = []
    for scene in drive.scenes:
        good = [scan for scan in scene.scans if (scene.name, scan.token) not in scans]
        if good and scene.name not in scenes:
            kept.append(replace(scene, scans=tuple(replace(scan, index=i) for i, scan in enumerate(good))))
    if not kept:
        nothing = Problem("no-scans", drive.root.name, "no scan of the log is good", "Mend the log and try again")
        raise DriveLogError([p for p in problems if p.severity != "warning"] or nothing)
    return replace(drive, scenes=tuple(kept), problems=tuple(p for p in problems if p.severity == "warning"))


@dataclass(slots=True)
class _SceneCheck:
    """Problems of one scene while its scans go by."""

    drive: Drive
    scene: Scene
    problems: list[Problem] = field(default_factory=list)
    tokens: set[str] = field(default_factory=set)
    sizes: dict[str, list[tuple[Scan, CameraFrame, tuple[int, int]]]] = field(default_factory=dict)
    hits: Counter[str] = field(default_factory=Counter)
    projected: Counter[str] = field(default_factory=Counter)

    def where(self, path: Path) -> str:
        return relative(path, self.drive.root)

    def error(self, code: str, path: Path, what: str, remedy: str) -> None:
        self.problems.append(Problem(code, self.where(path), what, remedy, "error", self.scene.name))

    def spoiled(self, scan: Scan, problem: Problem) -> None:
        self.problems.append(replace(problem, severity="scan", scene=self.scene.name, scan=scan.token))

    def scan(self, scan: Scan) -> None:
        """Look at one scan, its images and its truth."""
        self.tokens.add(scan.token)
        rows = self._points(scan)
        self._truth(scan)
        sample = None if rows is None else rows[:: max(1, len(rows) // _SAMPLE), :3].astype(np.float64)
        seen = []
        for camera in scan.cameras:
            size = self._image(scan, camera)
            if size is None or sample is None or size != (camera.size or size):
                continue  # an image of another size has a problem of its own, and tells nothing about calibration
            inside = _any_inside(sample, scan, camera, size)
            self.projected[camera.channel] += 1
            self.hits[camera.channel] += inside
            seen.append(inside)
        if seen and not any(seen):
            what = f"no point falls into any of the scan's {len(seen)} images"
            remedy = "Correct the calibration or the poses of this scan, or leave it out"
            self.spoiled(scan, Problem("no-point-in-image", self.where(scan.path), what, remedy))

    def finish(self) -> list[Problem]:
        """The scene's problems, with those that only all its scans together show."""
        self._image_sizes()
        self._time()
        for channel, count in self.projected.items():
            if not self.hits[channel]:
                what = f"under the calibration of {channel} no point of {count} scan(s) falls into its image"
                remedy = "Correct the calibration of this camera, or leave the camera out"
                where = f"{self.scene.name}/{channel}"
                self.problems.append(Problem("no-point-in-image", where, what, remedy, "error", self.scene.name))
        keyframes = [scan for scan in self.scene.scans if scan.is_keyframe]
        blind = sum(not scan.cameras for scan in keyframes)
        if blind and blind == len(keyframes):
            what = "no scan of the scene has an image, so there is nothing to label from"
            remedy = "Add the images; without them the log can only be evaluated"
            self.problems.append(Problem("no-images", self.scene.name, what, remedy, "error", self.scene.name))
        elif blind:
            what = f"{blind} of {len(keyframes)} scans have no image; they get labels from their neighbours only"
            remedy = "Add the images, if there are any"
            self.problems.append(Problem("no-images", self.scene.name, what, remedy, "warning", self.scene.name))
        return self.problems

    def _points(self, scan: Scan) -> NDArray[np.float32] | None:
        where = self.where(scan.path)
        try:
            rows = read_rows(scan.path, self.drive.root, COLUMNS[self.drive.format])
        except DriveLogError as error:
            for problem in error.problems:
                self.spoiled(scan, problem)
            return None
        if len(rows) < _FEWEST_POINTS:
            what = f"the scan has {len(rows)} point(s), fewer than {_FEWEST_POINTS}"
            remedy = "Copy the file again from the recording, or leave this scan out"
            self.spoiled(scan, Problem("truncated-scan", where, what, remedy))
            return None
        xyz = rows[:, :3]
        largest = float(np.abs(xyz).max())
        if not np.isfinite(largest):
            bad = int((~np.isfinite(xyz).all(axis=1)).sum())
            self.spoiled(scan, non_finite(where, bad, len(xyz)))
            return None
        if largest > _FARTHEST:
            bad = int((np.abs(xyz) > _FARTHEST).any(axis=1).sum())
            what = f"{bad} of {len(xyz)} points are farther than {_FARTHEST / 1000:g} km, up to {largest:.3g} m"
            columns = COLUMNS[self.drive.format]
            remedy = f"Write points as {columns} little-endian float32 values in metres, or leave this scan out"
            self.spoiled(scan, Problem("implausible-points", where, what, remedy))
            return None
        return rows

    def _truth(self, scan: Scan) -> None:
        if scan.truth_path is None:
            return
        where = self.where(scan.truth_path)
        try:
            labels = truth_length(scan.truth_path)
            size = scan.path.stat().st_size if scan.path.exists() else None
        except ValueError as error:
            self.spoiled(scan, bad_truth(where, str(error)))
        except OSError:
            self.spoiled(scan, missing_file(where, "truth file"))
        else:
            points = None if size is None else size // (4 * COLUMNS[self.drive.format])
            if points is not None and labels != points:
                self.spoiled(scan, wrong_length(where, labels, points))

    def _image(self, scan: Scan, camera: CameraFrame) -> tuple[int, int] | None:
        try:
            size = image_size(camera.path)
        except BadImage as error:
            remedy = "Copy the image again from the recording, or leave this scan out"
            self.spoiled(scan, Problem("bad-image", self.where(camera.path), str(error), remedy))
            return None
        except (OSError, ValueError):
            self.spoiled(scan, missing_file(self.where(camera.path), "image"))
            return None
        self.sizes.setdefault(camera.channel, []).append((scan, camera, size))
        return size

    def _image_sizes(self) -> None:
        """Images that differ from the declared size, or, where none is declared, from the camera's other images."""
        for entries in self.sizes.values():
            usual = Counter(size for _, _, size in entries).most_common(1)[0][0]
            for scan, camera, size in entries:
                expected = camera.size or usual
                if size != expected:
                    says = "the log declares" if camera.size else "this camera's other images have"
                    what = f"the image has {size[0]}x{size[1]} pixels, {says} {expected[0]}x{expected[1]}"
                    remedy = "Use the images that the calibration was made for, or leave this scan out"
                    self.spoiled(scan, Problem("wrong-image-size", self.where(camera.path), what, remedy))

    def _time(self) -> None:
        scans = self.scene.scans
        good = set(longest_increasing([scan.timestamp for scan in scans]))
        previous: Scan | None = None
        for position, scan in enumerate(scans):
            if position in good:
                previous = scan
                continue
            beside = f", and the scan before has {previous.timestamp}" if previous else ""
            what = f"the time stamp {scan.timestamp} µs is out of order{beside}"
            remedy = "Correct the time stamps of the log, or leave this scan out"
            self.spoiled(scan, Problem("time-order", self.where(scan.path), what, remedy))


def _any_inside(points: NDArray[np.float64], scan: Scan, camera: CameraFrame, size: tuple[int, int]) -> bool:
    """Whether any of (N, 3) lidar-frame points lies in front of the camera and inside its image."""
    in_camera = apply(scan.lidar_to_camera(camera), points)
    in_camera = in_camera[in_camera[:, 2] > _NEAREST]
    pixels = in_camera @ camera.intrinsic.T
    with np.errstate(over="ignore", invalid="ignore"):
        u, v = pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2]
    return bool(((u > 1) & (u < size[0] - 1) & (v > 1) & (v < size[1] - 1)).any())


def longest_increasing(values: Sequence[int]) -> list[int]:
    """Positions of a longest strictly increasing subsequence, so that one wrong value accuses itself and not its heirs.

    Patience sorting: ``tails[k]`` is the position of the smallest value that ends an increasing run of k + 1 values.
    """
    tails: list[int] = []
    ends: list[int] = []
    before: list[int] = []
    for position, value in enumerate(values):
        length = bisect_left(ends, value)
        before.append(tails[length - 1] if length else -1)
        if length == len(ends):
            ends.append(value)
            tails.append(position)
        else:
            ends[length] = value
            tails[length] = position
    chain = []
    position = tails[-1] if tails else -1
    while position >= 0:
        chain.append(position)
        position = before[position]
    return chain[::-1]
