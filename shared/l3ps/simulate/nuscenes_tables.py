"""The thirteen tables of nuScenes v1.0 and its two label tables, filled row by row.

Written so that the official devkit opens the log: every token resolves, every chain of prev and next is closed, the
map mask exists. Column meanings: nuScenes schema, docs/schema_nuscenes.md of the devkit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..taxonomy import NUSCENES_RAW_INDEX

VERSION = "v1.0-mini"
"""Name of the table folder; the devkit knows only the published versions' names."""
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "lidarseg", "log", "map", "panoptic",
    "sample", "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider",
    "pedestrian.sitting_lying_down", "pedestrian.standing", "pedestrian.moving",
)  # fmt: skip
VISIBILITIES = ("v0-40", "v40-60", "v60-80", "v80-100")
Row = dict[str, Any]
Double = NDArray[np.float64]


def quaternion(rotation: Double) -> list[float]:
    """A rotation matrix as (w, x, y, z) (Shepperd's method: divide by the largest component)."""
    m = np.asarray(rotation, dtype=np.float64)
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    largest = int(squares.argmax())
    rows = (
        (squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]),
        (m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]),
        (m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]),
        (m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]),
    )
    q = np.asarray(rows[largest]) / (2 * np.sqrt(squares[largest]))
    return [float(value) for value in q * (1 if q[0] >= 0 else -1)]


class Tables:
    """Rows of all tables; tokens are derived from the seed and the row's meaning, so equal seeds give equal files."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self.rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        self._last_data: dict[str, Row] = {}
        self._last_annotation: dict[str, Row] = {}
        self._instances: dict[str, Row] = {}
        self._fixed()

    def token(self, *meaning: object) -> str:
        """The token of a row: 32 hexadecimal digits."""
        text = "/".join(str(part) for part in (self._seed, *meaning))
        return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()

    def add(self, table: str, token: str, **columns: Any) -> Row:
        """Append a row and return it."""
        row = {"token": token, **columns}
        self.rows[table].append(row)
        return row

    def _fixed(self) -> None:
        for index, name in enumerate(NUSCENES_RAW_INDEX):
            self.add("category", self.token("category", name), name=name, description="", index=index)
        for name in ATTRIBUTES:
            self.add("attribute", self.token("attribute", name), name=name, description="")
        for index, level in enumerate(VISIBILITIES, start=1):
            self.add("visibility", str(index), level=level, description=f"visibility between {level[1:]}%")

    def sensor(self, channel: str, modality: str) -> None:
        """Declare a sensor of the vehicle."""
        self.add("sensor", self.token("sensor", channel), channel=channel, modality=modality)

    def calibrated_sensor(self, scene: str, channel: str, to_ego: Double, intrinsic: Double | None = None) -> None:
        """The calibration of a sensor during one scene."""
        self.add(
            "calibrated_sensor",
            self.token("calibrated_sensor", scene, channel),
            sensor_token=self.token("sensor", channel),
            translation=[float(v) for v in to_ego[:3, 3]],
            rotation=quaternion(to_ego[:3, :3]),
            camera_intrinsic=[] if intrinsic is None else [[float(v) for v in row] for row in intrinsic],
        )

    def scene(self, name: str, timestamps: Sequence[int], date: str, description: str) -> list[str]:
        """A scene with its log and its samples.

        Args:
            name: of the scene.
            timestamps: of its keyframes, microseconds.
            date: of capture, YYYY-MM-DD.
            description: free text.

        Returns:
            The sample tokens.
        """
        log, scene = self.token("log", name), self.token("scene", name)
        samples = [self.token("sample", name, index) for index in range(len(timestamps))]
        self.add("log", log, logfile=name, vehicle="simulated", date_captured=date, location="simulated-street")
        self.add(
            "map", self.token("map", name), category="semantic_prior", filename=f"maps/{name}.png", log_tokens=[log]
        )
        self.add(
            "scene", scene, log_token=log, nbr_samples=len(samples), first_sample_token=samples[0],
            last_sample_token=samples[-1], name=name, description=description,
        )  # fmt: skip
        for i, (token, timestamp) in enumerate(zip(samples, timestamps, strict=True)):
            before, after = samples[i - 1] if i else "", samples[i + 1] if i + 1 < len(samples) else ""
            self.add("sample", token, timestamp=timestamp, prev=before, next=after, scene_token=scene)
        self._last_data.clear()
        self._last_annotation.clear()
        return samples

    def sample_data(
        self, sample: str, scene: str, channel: str, timestamp: int, ego_to_world: Double, filename: str,
        size: tuple[int, int] | None = None,
    ) -> str:  # fmt: skip
        """One file of one sensor with its ego pose; returns its token.

        Args:
            sample: token of the keyframe.
            scene, channel: name the calibration.
            timestamp: microseconds.
            ego_to_world: (4, 4).
            filename: relative to the log.
            size: (width, height) of an image, None for points.
        """
        token = self.token("sample_data", sample, channel)
        self.add(
            "ego_pose", token, timestamp=timestamp, rotation=quaternion(ego_to_world[:3, :3]),
            translation=[float(v) for v in ego_to_world[:3, 3]],
        )  # fmt: skip
        width, height = size or (0, 0)
        before = self._last_data.get(channel)
        row = self.add(
            "sample_data", token, sample_token=sample, ego_pose_token=token,
            calibrated_sensor_token=self.token("calibrated_sensor", scene, channel), timestamp=timestamp,
            fileformat="jpg" if size else "pcd", is_key_frame=True, height=height, width=width, filename=filename,
            prev=before["token"] if before else "", next="",
        )  # fmt: skip
        if before:
            before["next"] = token
        self._last_data[channel] = row
        return token

    def labels(self, data: str) -> tuple[str, str]:
        """Register the label files of a sweep; returns their names (lidarseg, panoptic) relative to the log."""
        names = f"lidarseg/{VERSION}/{data}_lidarseg.bin", f"panoptic/{VERSION}/{data}_panoptic.npz"
        for table, name in zip(("lidarseg", "panoptic"), names, strict=True):
            self.add(table, data, sample_data_token=data, filename=name)
        return names

    def annotation(
        self, sample: str, instance: str, category: str, attribute: str, center_to_world: Double,
        size: tuple[float, float, float], points: int, visible: float,
    ) -> None:  # fmt: skip
        """A box at a keyframe; the instance's row is made at its first.

        Args:
            sample: token of the keyframe.
            instance: names the object within the drive.
            category, attribute: nuScenes names; attribute may be empty.
            center_to_world: (4, 4) pose of the box's middle.
            size: width, length, height in metres.
            points: LiDAR returns inside the box.
            visible: share of the object in sight, 0..1.
        """
        key, token = self.token("instance", instance), self.token("annotation", sample, instance)
        before = self._last_annotation.get(instance)
        level = 1 + sum(visible >= bound for bound in (0.4, 0.6, 0.8))
        row = self.add(
            "sample_annotation", token, sample_token=sample, instance_token=key, visibility_token=str(level),
            attribute_tokens=[self.token("attribute", attribute)] if attribute else [],
            translation=[float(v) for v in center_to_world[:3, 3]], size=[float(v) for v in size],
            rotation=quaternion(center_to_world[:3, :3]), prev=before["token"] if before else "", next="",
            num_lidar_pts=points, num_radar_pts=0,
        )  # fmt: skip
        if before:
            before["next"] = token
            self._instances[instance]["nbr_annotations"] += 1
            self._instances[instance]["last_annotation_token"] = token
        else:
            self._instances[instance] = self.add(
                "instance", key, category_token=self.token("category", category), nbr_annotations=1,
                first_annotation_token=token, last_annotation_token=token,
            )  # fmt: skip
        self._last_annotation[instance] = row

    def write(self, folder: Path) -> None:
        """Write one JSON file a table into ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in TABLES:
            (folder / f"{name}.json").write_text(json.dumps(self.rows[name], indent=0))
