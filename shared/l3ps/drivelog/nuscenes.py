"""nuScenes v1.0: JSON tables beside ``samples/`` and ``sweeps/`` (nuScenes schema, Caesar et al. 2020).

The truth comes from ``panoptic.json`` where the log has one, else from ``lidarseg.json`` (Fong et al. 2022).
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import DriveLogError, Problem
from ..geometry import Matrix, transform
from .names import resolve
from .nuscenes_tables import EXPORT, Log, lidar_channel, read_tables
from .nuscenes_truth import read_truth
from .points import COLUMNS, read_intrinsic, read_points
from .tables import Row, finite_numbers, in_order
from .types import CameraFrame, Drive, Scan, Scene

_PLAUSIBLE_HEIGHT: Final = (0.5, 4.0)
"""Metres above the ego frame's origin. nuScenes puts it on the ground; another writer may put it in the LiDAR."""

_Entries = list[tuple[Row, Row]]
"""(sample_data row, sensor row) of one sample, in table order, which is also the devkit's order of cameras."""


def open_nuscenes(root: Path, version: Path, *, sweeps: bool = False) -> Drive:
    """Open a log in the nuScenes layout.

    Args:
        root: the log: the folder that the file names in the tables start from.
        version: the folder of the tables, e.g. ``root/v1.0-mini``.
        sweeps: also yield the LiDAR sweeps between keyframes, without cameras.

    Returns:
        The drive; what could not be resolved is in its ``problems``.

    Raises:
        DriveLogError: the tables themselves are unusable (all their problems), or no scan is left.
    """
    log = Log(root, version.name)
    read_tables(log, version, sweeps)
    if log.problems:
        raise DriveLogError(log.problems)
    by_scene = _group(log, lidar_channel(log))
    builder = _Builder(log)
    scenes = []
    for row in log.scenes:
        scans = builder.scans(row["name"], by_scene[row["token"]])
        if scans:
            scenes.append(Scene(row["name"], tuple(scans)))
        else:
            log.report("no-scans", "scene", f"scene {row['name']} has no usable LiDAR scan", scene=row["name"])
    if not scenes:
        empty = Problem("no-scans", log.where("scene"), "the log has no scene with a usable LiDAR scan", EXPORT)
        spoilt = any(problem.severity != "warning" for problem in log.problems)
        raise DriveLogError(log.problems if spoilt else [empty, *log.problems])
    height = float(np.median([scene.scans[0].lidar_to_ego[2, 3] for scene in scenes]))
    return Drive(
        root=root,
        format="nuscenes",
        scenes=tuple(scenes),
        truth_space="nuscenes",
        sensor_height=height if _PLAUSIBLE_HEIGHT[0] <= height <= _PLAUSIBLE_HEIGHT[1] else None,
        problems=tuple(log.problems),
    )


def _group(log: Log, channel: str) -> dict[str, dict[str, _Entries]]:
    """scene token → sample token → rows of its LiDAR and cameras."""
    names = {row["token"]: row["name"] for row in log.scenes}
    groups: dict[str, dict[str, _Entries]] = {token: {} for token in names}
    astray = 0
    for sample in log.samples.values():
        if sample["scene_token"] in groups:
            groups[sample["scene_token"]][sample["token"]] = []
        else:
            astray += 1
    if astray:
        log.report("unknown-token", "sample", f"{astray} sample(s) belong to no scene of the log", severity="warning")
    astray = 0
    unknown: Counter[tuple[str, str]] = Counter()
    for row in log.data:
        parent = log.samples.get(row["sample_token"])
        if parent is None or parent["scene_token"] not in groups:
            astray += 1
            continue
        sensor = log.sensor(row)
        if sensor is None:
            unknown[names[parent["scene_token"]], row["calibrated_sensor_token"]] += 1
        elif sensor["modality"] == "camera" or sensor["channel"] == channel:
            groups[parent["scene_token"]][parent["token"]].append((row, sensor))
    for (scene, token), count in unknown.items():
        what = f"{count} row(s) name the calibrated sensor {token}, which calibrated_sensor.json or sensor.json lacks"
        log.report("missing-calibration", "sample_data", what, scene=scene)
    if astray:
        what = f"{astray} row(s) belong to a sample or scene that the log does not have"
        log.report("unknown-token", "sample_data", what, severity="warning")
    return groups


class _Builder:
    """Puts scans together from table rows; whatever does not resolve becomes a problem of the log."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self._calibration: dict[str, Matrix | str] = {}

    def scans(self, scene: str, samples: dict[str, _Entries]) -> list[Scan]:
        """The scans of one scene in the order of its links."""
        log = self.log
        ordered, linked = in_order([log.samples[token] for token in samples])
        if not linked:
            what = f"the prev/next links of scene {scene} do not form one chain; its scans are ordered by time"
            log.report("broken-links", "sample", what, scene=scene, severity="warning")
        rows: list[Row] = []
        cameras: dict[str, _Entries] = {}
        for sample in ordered:
            entries = samples[sample["token"]]
            lidar = [row for row, sensor in entries if sensor["modality"] == "lidar"]
            keys = [row for row in lidar if row["is_key_frame"]]
            if len(keys) != 1:
                what = f"sample {sample['token']} has {len(keys)} LiDAR keyframes instead of one"
                log.report("missing-scan", "sample_data", what, scene=scene, severity="scan")
            for key in keys[:1]:
                cameras[key["token"]] = [(row, sensor) for row, sensor in entries if sensor["modality"] == "camera"]
            rows.extend(row for row in lidar if not row["is_key_frame"] or row is keys[0])
        if len(rows) > len(cameras):  # with sweeps, whose own links run through the keyframes
            rows, _ = in_order(rows)
        scans: list[Scan] = []
        for row in rows:
            scan = self._scan(scene, row, cameras.get(row["token"], []), len(scans))
            if scan is not None:
                scans.append(scan)
        return scans

    def _scan(self, scene: str, row: Row, cameras: _Entries, index: int) -> Scan | None:
        log, token = self.log, row["token"]
        path = self._file(row["filename"], "sample_data", scene, token)
        extrinsic = self._extrinsic(row, scene)
        pose = self._pose(row, scene, token)
        if path is None or extrinsic is None or pose is None:
            return None
        frames = [self._camera(scene, token, entry, sensor) for entry, sensor in cameras]
        load_truth, truth_path = None, None
        if token in log.truth:
            kind, filename = log.truth[token]
            truth_path = self._file(filename, kind, scene, token)
            if truth_path is not None:
                load_truth = partial(read_truth, truth_path, kind, log.lut, path, log.root)
        return Scan(
            token=token,
            index=index,
            timestamp=row["timestamp"],
            path=path,
            lidar_to_ego=extrinsic,
            ego_to_world=pose,
            cameras=tuple(frame for frame in frames if frame is not None),
            load_points=partial(read_points, path, log.root, COLUMNS["nuscenes"]),
            load_truth=load_truth,
            is_keyframe=row["is_key_frame"],
            truth_path=truth_path,
        )

    def _camera(self, scene: str, scan: str, row: Row, sensor: Row) -> CameraFrame | None:
        path = self._file(row["filename"], "sample_data", scene, scan)
        extrinsic = self._extrinsic(row, scene)
        pose = self._pose(row, scene, scan)
        token = row["calibrated_sensor_token"]
        try:
            intrinsic = read_intrinsic(self.log.calibrated[token]["camera_intrinsic"])
        except (ValueError, TypeError, OverflowError) as error:
            what = f"calibrated sensor {token} of camera {sensor['channel']}: {error}"
            self.log.report("bad-calibration", "calibrated_sensor", what, scene=scene)
            return None
        if path is None or extrinsic is None or pose is None:
            return None
        width, height = row["width"] or 0, row["height"] or 0
        size = (width, height) if width > 0 and height > 0 else None
        return CameraFrame(sensor["channel"], path, row["timestamp"], size, intrinsic, extrinsic, pose)

    def _file(self, name: str, table: str, scene: str, scan: str) -> Path | None:
        path = resolve(self.log.root, name, self.log.where(table), scene=scene, scan=scan)
        if isinstance(path, Path):
            return path
        self.log.add(path)
        return None

    def _extrinsic(self, row: Row, scene: str) -> Matrix | None:
        """The extrinsic of a row's calibrated sensor; each is worked out once."""
        token = row["calibrated_sensor_token"]
        if token not in self._calibration:
            self._calibration[token] = _rigid(f"calibrated sensor {token}", self.log.calibrated[token])
        matrix = self._calibration[token]
        if isinstance(matrix, str):
            self.log.report("bad-calibration", "calibrated_sensor", matrix, scene=scene)
            return None
        return matrix

    def _pose(self, row: Row, scene: str, scan: str) -> Matrix | None:
        token = row["ego_pose_token"]
        entry = self.log.poses.get(token)
        pose = _rigid(f"ego pose {token}", entry) if entry else f"ego pose {token} of sample_data.json is missing"
        if isinstance(pose, str):
            self.log.report("bad-pose", "ego_pose", pose, scene=scene, scan=scan, severity="scan")
            return None
        return pose


def _rigid(what: str, row: Row) -> Matrix | str:
    rotation, translation = finite_numbers(row["rotation"], 4), finite_numbers(row["translation"], 3)
    if rotation is None or translation is None:
        return f"{what} does not hold a rotation of four and a translation of three finite numbers"
    try:
        return transform(rotation, translation)
    except ValueError as error:
        return f"{what}: {error}"
