"""The nuScenes v1.0 tables: which columns a reader needs of each, and the rows by token."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import DriveLogError, Problem
from ..taxonomy import NUSCENES_RAW_INDEX, nuscenes_raw_lut
from .names import is_file_name, is_plain_name
from .nuscenes_truth import TruthKind
from .tables import Row, Table, is_flag, is_integer, is_list, is_text, is_token, read_table, unique

EXPORT: Final = "Export the nuScenes v1.0 tables again; all tables of a log belong together"
_REMEDY: Final = {
    "bad-calibration": "Correct the calibration in that row",
    "missing-calibration": "Add the calibration of every sensor that recorded data",
    "bad-pose": "Correct the ego pose, or leave this scan out",
    "missing-scan": "Give every sample one LiDAR keyframe, or leave it out",
    "several-lidars": "Nothing to do, unless another LiDAR should be labelled",
}

_SCENE: Final = Table("scene", {"token": is_token, "name": is_plain_name})
_SAMPLE: Final = Table(
    "sample",
    {"token": is_token, "timestamp": is_integer, "scene_token": is_token},
    {"prev": is_text, "next": is_text},
)
_SENSOR: Final = Table("sensor", {"token": is_token, "channel": is_plain_name, "modality": is_text})
_CALIBRATED: Final = Table(
    "calibrated_sensor",
    {"token": is_token, "sensor_token": is_token, "translation": is_list, "rotation": is_list},
    {"camera_intrinsic": is_list},
)
_SAMPLE_DATA: Final = Table(
    "sample_data",
    {
        "token": is_file_name,
        "sample_token": is_token,
        "ego_pose_token": is_token,
        "calibrated_sensor_token": is_token,
        "timestamp": is_integer,
        "is_key_frame": is_flag,
        "filename": is_text,
    },
    {"width": is_integer, "height": is_integer, "prev": is_text, "next": is_text},
)
_EGO_POSE: Final = Table("ego_pose", {"token": is_token, "translation": is_list, "rotation": is_list})
_CATEGORY: Final = Table("category", {"name": is_text}, {"index": is_integer}, required=False)


@dataclass(slots=True)
class Log:
    """The tables of a log and what is wrong with them.

    Attributes:
        root: the folder that file names start from.
        version: name of the tables' folder.
        problems: found so far.
        scenes: rows in file order; ``samples``, ``sensors``, ``calibrated`` and ``poses``: rows by token.
        data: the sample_data rows of LiDARs and cameras.
        truth: sample_data token → kind and name of its truth file.
        lut: (256,) uint8, raw category index → challenge class.
    """

    root: Path
    version: str
    problems: list[Problem] = field(default_factory=list)
    scenes: list[Row] = field(default_factory=list)
    samples: dict[str, Row] = field(default_factory=dict)
    sensors: dict[str, Row] = field(default_factory=dict)
    calibrated: dict[str, Row] = field(default_factory=dict)
    poses: dict[str, Row] = field(default_factory=dict)
    data: list[Row] = field(default_factory=list)
    truth: dict[str, tuple[TruthKind, str]] = field(default_factory=dict)
    lut: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(256, np.uint8))
    _seen: set[Problem] = field(default_factory=set)

    def where(self, table: str) -> str:
        """A table's file, relative to the log."""
        return f"{self.version}/{table}.json"

    def sensor(self, row: Row) -> Row | None:
        """The sensor of a sample_data row, or None when the tables do not connect."""
        calibrated = self.calibrated.get(row["calibrated_sensor_token"])
        return None if calibrated is None else self.sensors.get(calibrated["sensor_token"])

    def report(
        self,
        code: str,
        table: str,
        what: str,
        *,
        scene: str | None = None,
        scan: str | None = None,
        severity: Literal["error", "scan", "warning"] = "error",
    ) -> None:
        """Note a problem with a table, once however many rows run into it."""
        self.add(Problem(code, self.where(table), what, _REMEDY.get(code, EXPORT), severity, scene, scan))

    def add(self, problem: Problem) -> None:
        """Note a problem unless it is noted already."""
        if problem not in self._seen:
            self._seen.add(problem)
            self.problems.append(problem)


def _truth_table(kind: TruthKind) -> Table:
    return Table(kind, {"sample_data_token": is_token, "filename": is_text}, required=False)


def read_tables(log: Log, folder: Path, sweeps: bool) -> None:
    """Fill a log from its folder of tables; everything wrong with them is in ``log.problems`` afterwards."""
    problems = log.problems
    log.scenes = read_table(folder, _SCENE, problems)
    log.sensors = unique(read_table(folder, _SENSOR, problems), log.where("sensor"), problems)
    log.calibrated = unique(read_table(folder, _CALIBRATED, problems), log.where("calibrated_sensor"), problems)
    log.samples = unique(read_table(folder, _SAMPLE, problems), log.where("sample"), problems)

    def wanted(row: Row) -> bool:
        sensor = log.sensor(row)
        if sensor is None:
            return bool(row["is_key_frame"])
        kind = sensor["modality"]
        return (kind == "camera" and row["is_key_frame"]) or (kind == "lidar" and (sweeps or row["is_key_frame"]))

    data = read_table(folder, _SAMPLE_DATA, problems, wanted)
    log.data = list(unique(data, log.where("sample_data"), problems).values())
    used = {row["ego_pose_token"] for row in log.data}
    log.poses = unique(
        read_table(folder, _EGO_POSE, problems, lambda row: row["token"] in used), log.where("ego_pose"), problems
    )
    kinds: tuple[TruthKind, ...] = ("lidarseg", "panoptic")
    for kind in kinds:  # the later one, which also has instances, replaces the earlier one
        for row in read_table(folder, _truth_table(kind), problems):
            log.truth[row["sample_data_token"]] = (kind, row["filename"])
    if log.truth:
        index = {
            row["name"]: row["index"]
            for row in read_table(folder, _CATEGORY, problems)
            if row["index"] is not None and 0 <= row["index"] < 256
        }
        log.lut = nuscenes_raw_lut(index or {name: i for i, name in enumerate(NUSCENES_RAW_INDEX)})
    for key in ("name", "token"):
        counts = Counter(row[key] for row in log.scenes)
        problems.extend(
            Problem(
                "duplicate-scene",
                log.where("scene"),
                f"{count} scenes have the {key} {value}",
                f"Give every scene a {key} of its own",
            )
            for value, count in counts.items()
            if count > 1
        )


def lidar_channel(log: Log) -> str:
    """The LiDAR to label: LIDAR_TOP, or the first one of the log."""
    channels = [row["channel"] for row in log.sensors.values() if row["modality"] == "lidar"]
    if not channels:
        raise DriveLogError(
            Problem(
                "no-lidar",
                log.where("sensor"),
                "the log has no sensor of modality 'lidar'",
                "Label a log that was recorded with a LiDAR",
            )
        )
    channel = "LIDAR_TOP" if "LIDAR_TOP" in channels else channels[0]
    if len(set(channels)) > 1:
        others = ", ".join(sorted(set(channels) - {channel}))
        log.report("several-lidars", "sensor", f"only {channel} is labelled, not {others}", severity="warning")
    return channel
