"""What the annotators of a scan would see: how many returns a box holds and how much of it is in sight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .lidar import BEAMS, HIGHEST, LOWEST, Sweep

Double = NDArray[np.float64]
LATTICE = np.array([[x, y, z] for x in (-0.8, 0, 0.8) for y in (-0.8, 0, 0.8) for z in (-0.8, 0, 0.8)])
"""Sample places of a box, in half extents."""


def center_pose(pose: Double, size: tuple[float, float, float]) -> Double:
    """(4, 4) pose of a box's middle from that of the object's origin on the ground."""
    lifted = np.asarray(pose, dtype=np.float64).copy()
    lifted[:3, 3] += lifted[:3, 2] * size[2] / 2
    return lifted


def points_inside(points: Double, center: Double, size: tuple[float, float, float]) -> int:
    """Number of points in a box.

    Args:
        points: (N, 3) in the frame that ``center`` leads to, metres, sorted by x (a scan has hundreds of boxes).
        center: (4, 4) pose of the box's middle.
        size: width, length, height in metres.
    """
    half = np.array([size[1], size[0], size[2]]) / 2
    radius = np.linalg.norm(half)
    first, last = np.searchsorted(points[:, 0], [center[0, 3] - radius, center[0, 3] + radius])
    local = (points[first:last] - center[:3, 3]) @ center[:3, :3]
    return int((np.abs(local) <= half).all(axis=1).sum())


def share_in_sight(sweep: Sweep, actor: int, center: Double, size: tuple[float, float, float]) -> float:
    """Share of a box from which nothing blocks the view to the LiDAR, judged at 27 places.

    Args:
        sweep: the scan.
        actor: index of the object, whose own surface does not count as blocking.
        center: (4, 4) box middle → lidar frame.
        size: width, length, height in metres.
    """
    half = np.array([size[1], size[0], size[2]]) / 2
    places = LATTICE * half @ center[:3, :3].T + center[:3, 3]
    distance = np.linalg.norm(places, axis=1)
    elevation = np.degrees(np.arcsin(places[:, 2] / distance))
    beam = np.rint((elevation - LOWEST) / (HIGHEST - LOWEST) * (BEAMS - 1)).astype(int)
    steps = sweep.ranges.shape[1]
    column = np.floor(np.arctan2(places[:, 1], places[:, 0]) / (2 * np.pi) * steps).astype(int) % steps
    judged = (beam >= 0) & (beam < BEAMS)
    if not judged.any():
        return 1.0
    beam, column, distance = beam[judged], column[judged], distance[judged]
    blocked = (sweep.ranges[beam, column] < distance - 0.3) & (sweep.actors[beam, column] != actor)
    return float(1 - blocked.mean())
