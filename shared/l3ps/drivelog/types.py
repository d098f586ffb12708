"""What every reader yields: Drive → Scene → Scan → CameraFrame, lazily loaded and free of any file format.

Frames: ``lidar`` (the scan's own), ``ego`` (the vehicle), ``world`` (fixed for a scene), ``camera`` (x right, y down,
z forward). A transform ``a_to_b`` is a (4, 4) float64 homogeneous matrix, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import Problem

LogFormat = Literal["nuscenes", "kitti-raw", "semantickitti"]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Points:
    """One scan's returns in file order, which is the order of the labels.

    Attributes:
        xyz: (N, 3) float32, metres, lidar frame.
        intensity: (N,) float32 in 0..1 (readers scale it).
        time: (N,) float64 seconds relative to the scan's time stamp, or None where the format has no point times.
        ring: (N,) uint16 beam index, or None.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    time: NDArray[np.float64] | None = None
    ring: NDArray[np.uint16] | None = None

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, slots=True)
class Truth:
    """Annotated labels of one scan, in the drive's truth space (``Drive.truth_space``).

    Attributes:
        semantic: (N,) uint8 class, 0 = void.
        instance: (N,) int32 id, 0 = none. Ids are unique per class.
        has_instances: False where the log has semantics only; such truth cannot be scored by PQ for things.
    """

    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    has_instances: bool = True


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """One exposure of one camera, matched to a scan.

    Attributes:
        channel: the camera's name.
        path: the image file.
        timestamp: microseconds.
        size: (width, height) in pixels as the log declares it, or None.
        intrinsic: (3, 3) float64 pinhole matrix, pixels.
        camera_to_ego: the extrinsic.
        ego_to_world: the ego pose at exposure, or None where the log has no poses.
    """

    channel: str
    path: Path
    timestamp: int
    size: tuple[int, int] | None
    intrinsic: Matrix
    camera_to_ego: Matrix
    ego_to_world: Matrix | None = None


@dataclass(frozen=True, slots=True)
class Scan:
    """One LiDAR sweep with the images that belong to it.

    Attributes:
        token: unique in the drive; names the label files.
        index: position in the scene, from 0.
        timestamp: microseconds.
        path: the point file.
        lidar_to_ego: the extrinsic.
        ego_to_world: the ego pose at the scan's time, or None where the log has no poses.
        cameras: the exposures matched to this scan; empty for a sweep between keyframes.
        is_keyframe: False for intermediate sweeps, which have no truth and get no label files unless asked.
        number: the scan's name within its scene where the format counts its files (``000007``), else None. Label
            files of a SemanticKITTI log are named after it.
        truth_path: the file the truth is read from, or None.
        load_points: reads the points; DriveLogError when the file is missing, truncated or not numeric.
        load_truth: reads the truth, or None where the scan has none.
    """

    token: str
    index: int
    timestamp: int
    path: Path
    lidar_to_ego: Matrix
    ego_to_world: Matrix | None
    cameras: tuple[CameraFrame, ...]
    load_points: Callable[[], Points] = field(repr=False)
    load_truth: Callable[[], Truth] | None = field(default=None, repr=False)
    is_keyframe: bool = True
    number: str | None = None
    truth_path: Path | None = None

    def lidar_to_camera(self, camera: CameraFrame) -> Matrix:
        """Transform lidar → ego → world → ego at exposure → camera (METHOD: projection).

        Without ego poses the vehicle is taken to stand still between scan and exposure.
        """
        chain = self.lidar_to_ego
        if self.ego_to_world is not None and camera.ego_to_world is not None:
            chain = np.linalg.inv(camera.ego_to_world) @ self.ego_to_world @ chain
        return np.asarray(np.linalg.inv(camera.camera_to_ego) @ chain, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Scene:
    """Temporally contiguous scans of one drive, in time order."""

    name: str
    scans: tuple[Scan, ...]


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive log opened for reading.

    Attributes:
        root: the directory the log lives in; file paths in messages are relative to it.
        format: which layout it has.
        scenes: the scenes, in the log's order.
        truth_space: name of the label space of its truth (``nuscenes`` or ``semantickitti``).
        sensor_height: height of the LiDAR above ground in metres where calibration tells it, else None.
        problems: what the reader could not resolve while it opened the log. The scans and images concerned are not
            among the scenes; :func:`l3ps.drivelog.validate` repeats these problems before its own.
    """

    root: Path
    format: LogFormat
    scenes: tuple[Scene, ...]
    truth_space: Literal["nuscenes", "semantickitti"]
    sensor_height: float | None = None
    problems: tuple[Problem, ...] = ()

    @property
    def has_truth(self) -> bool:
        """Whether any scan carries annotated labels."""
        return any(scan.load_truth is not None for scene in self.scenes for scan in scene.scans)
