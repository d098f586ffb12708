"""Points → pixels → primal labels (paper, section III-C; METHOD 2)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from l3ps.segment.panoptic import PanopticImage

MIN_DEPTH = 1.0
"""Metres in front of the camera; nearer points are the vehicle itself (published)."""
MARGIN = 1.0
"""Pixels at the image's rim that get no point (published)."""


def project(
    xyz: NDArray[np.float32],
    lidar_to_camera: NDArray[np.float64],
    intrinsic: NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Pinhole projection of a scan into one image.

    Args:
        xyz: (N, 3) float32, metres, lidar frame.
        lidar_to_camera: (4, 4) float64.
        intrinsic: (3, 3) float64, pixels.
        size: (width, height) of the image in pixels.

    Returns:
        (N, 2) float64 pixel coordinates (u right, v down), (N,) float64 depth in metres along the optical axis, and
        (N,) bool whether the point falls into the image. Coordinates of points that do not are meaningless.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # points that are not finite fail every comparison below
        camera = xyz.astype(np.float64) @ lidar_to_camera[:3, :3].T + lidar_to_camera[:3, 3]
        depth = camera[:, 2]
        ahead = depth > MIN_DEPTH
        uvw = camera @ intrinsic.T
        uv = uvw[:, :2] / uvw[:, 2:]
        inside = (uv > MARGIN).all(axis=1) & (uv[:, 0] < size[0] - MARGIN) & (uv[:, 1] < size[1] - MARGIN)
    return uv, depth, ahead & inside


def primal_labels(
    xyz: NDArray[np.float32],
    views: Iterable[tuple[PanopticImage, NDArray[np.float64], NDArray[np.float64]]],
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Label each point of a scan by the pixel it falls on; a later camera overwrites an earlier one.

    Instance ids are made unique over the scan's images, so that two objects in two cameras never share one.

    Args:
        xyz: (N, 3) float32, metres, lidar frame.
        views: per camera the panoptic image, lidar_to_camera (4, 4) and the intrinsic (3, 3).

    Returns:
        (N,) uint8 ``NUSCENES16`` class, 0 where no camera sees the point, and (N,) int32 instance id, 0 = none.
    """
    semantic = np.zeros(len(xyz), dtype=np.uint8)
    instance = np.zeros(len(xyz), dtype=np.int32)
    taken = 0
    for image, lidar_to_camera, intrinsic in views:
        uv, _, seen = project(xyz, lidar_to_camera, intrinsic, image.size)
        height, width = image.semantic.shape
        column = (uv[seen, 0] * (width / image.size[0])).astype(np.intp)
        row = (uv[seen, 1] * (height / image.size[1])).astype(np.intp)
        semantic[seen] = image.semantic[row, column]
        ids = image.instance[row, column]
        instance[seen] = np.where(ids > 0, ids + taken, 0)
        taken += int(image.instance.max(initial=0))
    return semantic, instance
