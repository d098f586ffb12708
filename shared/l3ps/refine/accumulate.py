"""Scans of a scene into one frame: KISS-ICP poses (paper, section III-D, step 1), and points moved by them.

KISS-ICP filters the frame it returns, so only its pose is taken and the raw points keep their order. One estimator
serves one scene: carried over, it would register the next scene against a map of another place.
"""

from __future__ import annotations

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from l3ps.errors import ProcessingError
from l3ps.geometry import Matrix
from l3ps.presets import Odometry

NO_TIMES = np.empty(0)
"""KISS-ICP reads an empty array as "do not deskew"; anything of another length than the scan fails, and equal times
abort the process."""


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


def transform(xyz: NDArray[np.float32], pose: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points (N, 3) float32 of the lidar frame in the frame that ``pose`` (4, 4) leads to.

    Computed in float64 and rounded once.
    """
    return (xyz.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


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
