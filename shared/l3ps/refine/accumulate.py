"""Scans of a scene into one frame: KISS-ICP poses (paper, section III-D, step 1), and points moved by them.

KISS-ICP filters the frame it returns, so only its pose is taken and the raw points keep their order. One estimator
serves one scene: carried over, it would register the next scene against a map of another place.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l3ps.errors import ProcessingError
from l3ps.geometry import Matrix
from l3ps.presets import Odometry

NO_TIMES = np.empty(0)
"""KISS-ICP reads an empty array as "do not deskew"; anything of another length than the scan fails, and equal times
abort the process. Scans are deskewed here, before it sees them."""
LONGEST_SWEEP = 1.0
"""Seconds; point times that span more are of another unit."""


class Odometer:
    """Registers the scans of one scene, in time order.

    Args:
        odometry: KISS-ICP's constants.
    """

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._estimator = KissICP(_config(odometry))
        self._scans = 0

    def __call__(self, xyz: NDArray[np.float32]) -> Matrix:
        """Pose of the next scan.

        Args:
            xyz: (N, 3) float32, metres, lidar frame; rows that are not finite are left out.

        Returns:
            (4, 4) float64 lidar → frame of the first scan.

        Raises:
            ProcessingError: when the scan has no point in range or its pose is not finite.
        """
        index, odometry = self._scans, self._odometry
        self._scans += 1
        reach = np.linalg.norm(xyz, axis=1)
        usable = xyz[(reach < odometry.max_range) & (reach > odometry.min_range)]  # neither holds for NaN
        if len(usable) == 0:
            raise ProcessingError(
                f"scan {index} has no point between {odometry.min_range:g} m and {odometry.max_range:g} m: "
                "it cannot be registered; leave the scan out or check its units."
            )
        self._estimator.register_frame(usable.astype(np.float64), NO_TIMES)
        if not np.isfinite(self._estimator.last_pose).all():
            raise ProcessingError(f"odometry diverged at scan {index}: its pose is not finite.")
        return np.array(self._estimator.last_pose)

    @property
    def step(self) -> Matrix:
        """(4, 4) float64 motion of the last scan: its lidar frame → that of the scan before."""
        return np.array(self._estimator.last_delta)

    def predict(self, step: Matrix) -> None:
        """Start the registration of the next scan from this motion instead of the last one's."""
        self._estimator.last_delta = np.array(step)

    def restart(self, xyz: NDArray[np.float32]) -> None:
        """Forget map and motion and start again with a scan, whose pose becomes the identity."""
        self._estimator = KissICP(_config(self._odometry))
        self._scans -= 1
        self(xyz)


def estimate_poses(scans: Iterable[NDArray[np.float32]], odometry: Odometry) -> NDArray[np.float64]:
    """Pose of each scan in the frame of the first; see :class:`Odometer`.

    Args:
        scans: per scan (N, 3) float32, metres, lidar frame, in time order; rows that are not finite are left out.
        odometry: KISS-ICP's constants.

    Returns:
        (S, 4, 4) float64 lidar → scene.

    Raises:
        ProcessingError: when a scan has no point in range or a pose is not finite.
    """
    odometer = Odometer(odometry)
    poses = [odometer(xyz) for xyz in scans]
    return np.stack(poses) if poses else np.empty((0, 4, 4))


def transform(xyz: NDArray[np.float32], pose: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points (N, 3) float32 of the lidar frame in the frame that ``pose`` (4, 4) leads to.

    Computed in float64 and rounded once.
    """
    return (xyz.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def twist(motion: Matrix, seconds: float) -> NDArray[np.float64]:
    """Constant velocity that makes up a motion.

    Args:
        motion: (4, 4) rigid transform, the later pose in the frame of the earlier.
        seconds: time between the two, > 0.

    Returns:
        (6,) float64: turn rate in rad/s, then speed in m/s, in the moving frame.
    """
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    # Inverse of the left Jacobian (Solà et al. 2018, eq. 146); its limit is 1/12 where the angle vanishes.
    bend = 1 / 12 if angle < 1e-4 else 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    speed = (np.eye(3) - cross / 2 + bend * cross @ cross) @ motion[:3, 3]
    return np.concatenate([turn, speed]) / seconds


def deskew(
    xyz: NDArray[np.float32], time: NDArray[np.float64] | None, velocity: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Points as if all were measured at the scan's time stamp, under constant velocity.

    Args:
        xyz: (N, 3) float32, metres, lidar frame at each point's own time.
        time: (N,) float64 seconds relative to the scan's time stamp; None, times that are all equal, not finite or
            span more than a sweep can take leave the points as they are.
        velocity: (6,) see :func:`twist`.

    Returns:
        (N, 3) float32, lidar frame at the scan's time stamp, in the same order.
    """
    if time is None or len(time) != len(xyz) or len(xyz) == 0 or not np.isfinite(time).all():
        return xyz
    if not 0 < np.ptp(time) <= LONGEST_SWEEP or np.abs(time).max() > LONGEST_SWEEP:
        return xyz
    turn, speed = velocity[:3], velocity[3:]
    rate = float(np.linalg.norm(turn))
    # Exponential map of se(3): along x(t) = R(t) x + p(t) with both in closed form (Solà et al. 2018, eq. 145 and 172).
    axis = turn / rate if rate > 1e-9 else np.zeros(3)
    angle = rate * time
    sin, cos = np.sin(angle)[:, None], np.cos(angle)[:, None]
    along = np.cross(axis, speed)
    straight = time[:, None] * speed
    if rate > 1e-9:
        straight += (1 - cos) / rate * along + (time[:, None] - sin / rate) * np.cross(axis, along)
    points = xyz.astype(np.float64)
    turned = points * cos + np.cross(axis, points) * sin + np.outer(points @ axis, axis) * (1 - cos)
    return np.asarray(turned + straight, dtype=np.float32)


def _config(odometry: Odometry) -> KISSConfig:
    # One thread: with more the sums of a registration are added in a changing order and two runs differ in the last
    # digits, for no gain (16 scans of 114,000 points: 0.56 s with one thread, 0.56 s with two).
    # model_construct: the normal constructor reads environment variables with the prefix kiss_icp_, and a stray one
    # would change the labels.
    return KISSConfig.model_construct(
        out_dir="",
        data=DataConfig(max_range=odometry.max_range, min_range=odometry.min_range, deskew=False),
        mapping=MappingConfig(voxel_size=odometry.voxel_size, max_points_per_voxel=odometry.max_points_per_voxel),
        registration=RegistrationConfig(max_num_threads=1),
        adaptive_threshold=AdaptiveThresholdConfig(
            initial_threshold=odometry.initial_threshold, min_motion_th=odometry.min_motion
        ),
    )
