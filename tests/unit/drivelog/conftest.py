"""Writers of small drive logs: a few scans of some hundred points and images of a few dozen pixels."""

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l3ps.drivelog import UnpackLimits, unpack
from l3ps.errors import DriveLogError

WIDTH, HEIGHT, FOCAL = 64, 48, 40.0
FORWARD = [0.5, -0.5, 0.5, -0.5]
"""Rotation camera → ego of a camera that looks ahead: x right, y down, z forward."""
Row = dict[str, Any]


def png(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    """A grey PNG image."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + b"\x80" * width for _ in range(height)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def cloud(seed: int, columns: int, count: int = 300) -> np.ndarray:
    """(N, columns) float32 returns all around the sensor."""
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(3, 40, count)
    rows = np.zeros((count, columns), np.float32)
    rows[:, 0], rows[:, 1] = distance * np.cos(angle), distance * np.sin(angle)
    rows[:, 2] = rng.uniform(-1.7, 1.0, count)
    rows[:, 3] = rng.uniform(0, 255 if columns == 5 else 1, count)
    if columns == 5:
        rows[:, 4] = rng.integers(0, 32, count)
    return rows


@dataclass
class NuScenesLog:
    """A log whose tables may be changed before :meth:`save`."""

    root: Path
    version: str = "v1.0-mini"
    tables: dict[str, list[Any]] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        return self.root / self.version

    def save(self) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.tables.items():
            (self.folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
        return self.root

    def rows(self, table: str, **having: Any) -> list[Row]:
        return [row for row in self.tables[table] if all(row[k] == v for k, v in having.items())]

    def scans(self) -> list[Row]:
        """The sample_data rows of the LiDAR keyframes, in order."""
        return [r for r in self.tables["sample_data"] if r["is_key_frame"] and "LIDAR" in r["filename"]]

    def write(self, name: str, content: bytes) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def truth(self, kind: str, labels: dict[str, np.ndarray]) -> None:
        """Give scans (by token) lidarseg or panoptic truth in raw categories."""
        self.tables[kind] = []
        for token, values in labels.items():
            name = f"{kind}/{self.version}/{token}_{kind}" + (".npz" if kind == "panoptic" else ".bin")
            self.tables[kind].append({"token": token, "sample_data_token": token, "filename": name})
            self.write(name, b"")
            if kind == "panoptic":
                np.savez_compressed(self.root / name, data=values.astype(np.uint16))
            else:
                values.astype(np.uint8).tofile(self.root / name)


@pytest.fixture
def nuscenes_log(tmp_path: Path) -> Callable[..., NuScenesLog]:
    """Make a nuScenes log: ``make(scenes=1, scans=3, sweeps=0, cameras=("CAM_FRONT",), root=None)``."""

    def make(
        scenes: int = 1,
        scans: int = 3,
        sweeps: int = 0,
        cameras: tuple[str, ...] = ("CAM_FRONT",),
        root: Path | None = None,
        version: str = "v1.0-mini",
    ) -> NuScenesLog:
        log = NuScenesLog(root or tmp_path / "log", version)
        channels = ["LIDAR_TOP", *cameras, "RADAR_FRONT"]
        t = log.tables = {name: [] for name in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data")}
        t["ego_pose"] = []
        for channel in channels:
            kind = {"L": "lidar", "C": "camera", "R": "radar"}[channel[0]]
            t["sensor"].append({"token": f"s-{channel}", "channel": channel, "modality": kind})
            t["calibrated_sensor"].append(
                {
                    "token": f"c-{channel}",
                    "sensor_token": f"s-{channel}",
                    "translation": [1.0, 0.0, 1.8 if kind == "lidar" else 1.5],
                    "rotation": FORWARD if kind == "camera" else [1, 0, 0, 0],
                    "camera_intrinsic": [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
                    if kind == "camera"
                    else [],
                }
            )
        for s in range(scenes):
            t["scene"].append({"token": f"scene{s}", "name": f"scene-{s:04d}"})
            lidar_chain = []
            for i in range(scans):
                stamp = 1_600_000_000_000_000 + s * 10**9 + i * 500_000
                links = {"prev": f"k{s}-{i - 1}" if i else "", "next": f"k{s}-{i + 1}" if i < scans - 1 else ""}
                t["sample"].append({"token": f"k{s}-{i}", "timestamp": stamp, "scene_token": f"scene{s}", **links})
                for channel in channels:
                    lidar = channel == "LIDAR_TOP"
                    for sweep in range(1 + sweeps if lidar else 1):
                        at = stamp + sweep * 50_000 + (0 if lidar else 20_000)
                        token = f"{channel}-{s}-{i}-{sweep}"
                        pose = f"p-{token}"
                        t["ego_pose"].append(
                            {
                                "token": pose,
                                "translation": [(at - stamp) * 1e-5 + 5.0 * i, 0, 0],
                                "rotation": [1, 0, 0, 0],
                            }
                        )
                        folder = "sweeps" if sweep else "samples"
                        name = f"{folder}/{channel}/{token}" + (".pcd.bin" if lidar else ".png")
                        row = {
                            "token": token,
                            "sample_token": f"k{s}-{i}",
                            "ego_pose_token": pose,
                            "calibrated_sensor_token": f"c-{channel}",
                            "timestamp": at,
                            "is_key_frame": sweep == 0,
                            "width": 0 if lidar else WIDTH,
                            "height": 0 if lidar else HEIGHT,
                            "filename": name,
                            "prev": "",
                            "next": "",
                        }
                        t["sample_data"].append(row)
                        if lidar:
                            lidar_chain.append(row)
                            log.write(name, cloud(100 * s + 10 * i + sweep, 5).tobytes())
                        elif channel in cameras:
                            log.write(name, png())
            for before, after in pairwise(lidar_chain):
                before["next"], after["prev"] = after["token"], before["token"]
        log.save()
        return log

    return make


KITTI_TR = "0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3"
"""LiDAR (x ahead, y left, z up) → camera (x right, y down, z ahead), with a small offset."""
KITTI_P = f"{FOCAL} 0 32 {{0}} 0 {FOCAL} 24 0 0 0 1 0"
"""Projection whose fourth column is -focal * baseline."""


def _write(path: Path, content: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.fixture
def kitti_raw_log(tmp_path: Path) -> Callable[..., Path]:
    """Make a KITTI raw log: ``make(drives=1, scans=3, cameras=("02",))``."""

    def make(drives: int = 1, scans: int = 3, cameras: tuple[str, ...] = ("02",)) -> Path:
        root = tmp_path / "kitti"
        day = root / "2011_09_26"
        r, t = "0 -1 0 0 0 -1 1 0 0", "0.1 -0.2 -0.3"
        _write(day / "calib_velo_to_cam.txt", f"calib_time: 15-Mar-2012 11:37:16\nR: {r}\nT: {t}\n")
        lines = ["calib_time: 09-Jan-2012 13:57:47", "R_rect_00: 1 0 0 0 1 0 0 0 1"]
        for number in ("00", "01", "02", "03"):
            lines += [
                f"S_rect_{number}: {WIDTH} {HEIGHT}",
                f"P_rect_{number}: {KITTI_P.format(-int(number) * FOCAL * 0.5)}",
            ]
        _write(day / "calib_cam_to_cam.txt", "\n".join(lines) + "\n")
        for d in range(drives):
            drive = day / f"2011_09_26_drive_{d:04d}_sync"
            stamps = "".join(f"2011-09-26 13:02:{25 + i // 10}.{i % 10}23456789\n" for i in range(scans))
            for folder in ("velodyne_points", *(f"image_{number}" for number in cameras)):
                _write(drive / folder / "timestamps.txt", stamps)
                for i in range(scans):
                    if folder == "velodyne_points":
                        _write(drive / folder / "data" / f"{i:010d}.bin", cloud(10 * d + i, 4).tobytes())
                    else:
                        _write(drive / folder / "data" / f"{i:010d}.png", png())
        return root

    return make


@pytest.fixture
def semantickitti_log(tmp_path: Path) -> Callable[..., Path]:
    """Make a SemanticKITTI log: ``make(sequences=("00",), scans=3, cameras=(2,), labels=True)``."""

    def make(
        sequences: tuple[str, ...] = ("00",), scans: int = 3, cameras: tuple[int, ...] = (2,), labels: bool = True
    ) -> Path:
        root = tmp_path / "semantickitti"
        for name in sequences:
            folder = root / "sequences" / name
            lines = [f"P{n}: {KITTI_P.format(-n * FOCAL * 0.5)}" for n in range(4)]
            _write(folder / "calib.txt", "\n".join([*lines, f"Tr: {KITTI_TR}"]) + "\n")
            _write(folder / "times.txt", "".join(f"{0.1 * i:.6e}\n" for i in range(scans)))
            # camera 0 drives 2 m ahead a scan: its z axis
            _write(folder / "poses.txt", "".join(f"1 0 0 0 0 1 0 0 0 0 1 {2.0 * i}\n" for i in range(scans)))
            for i in range(scans):
                points = cloud(i, 4)
                _write(folder / "velodyne" / f"{i:06d}.bin", points.tobytes())
                if labels:
                    values = np.full(len(points), 40, np.uint32)
                    values[:20] = 10 | 7 << 16
                    values[20:30] = 252 | 8 << 16
                    _write(folder / "labels" / f"{i:06d}.label", values.astype("<u4").tobytes())
                for n in cameras:
                    _write(folder / f"image_{n}" / f"{i:06d}.png", png())
        return root

    return make


@pytest.fixture
def make_png() -> Callable[..., bytes]:
    """``make_png(width, height)``: a PNG image as bytes."""
    return png


@pytest.fixture
def place(tmp_path):
    """A folder with nothing but the archive: whatever else is there after a failure was left behind."""

    class Place:
        archive = tmp_path / "in" / "upload"
        target = tmp_path / "out" / "log"

        def unpack(self, content: bytes, limits: UnpackLimits = UnpackLimits(), **options) -> dict[str, bytes]:
            self.archive.parent.mkdir(exist_ok=True)
            self.archive.write_bytes(content)
            root = unpack(self.archive, self.target, limits, **options)
            assert self.left() == {self.target}
            return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}

        def refused(self, content: bytes, limits: UnpackLimits = UnpackLimits()) -> tuple[str, str]:
            with pytest.raises(DriveLogError) as caught:
                self.unpack(content, limits)
            assert self.left() == set()
            assert {p.name for p in tmp_path.iterdir()} <= {"in", "out"}
            (problem,) = caught.value.problems
            assert problem.remedy
            return problem.code, str(problem)

        def left(self) -> set[Path]:
            return set(self.target.parent.iterdir()) if self.target.parent.exists() else set()

    return Place()
