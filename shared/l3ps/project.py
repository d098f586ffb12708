"""Points → pixels → primal labels and what the cameras say beyond them (paper, section III-C; METHOD 2)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import CANDIDATES, ONE_VOTE, Evidence
from l3ps.segment.panoptic import PanopticImage
from l3ps.taxonomy import NUSCENES16

MIN_DEPTH = 1.0
"""Metres in front of the camera; nearer points are the vehicle itself (published)."""
MARGIN = 1.0
"""Pixels at the image's rim that get no point (published)."""

View = tuple[PanopticImage, NDArray[np.float64], NDArray[np.float64]]
"""A camera's panoptic image, its lidar_to_camera (4, 4) and intrinsic (3, 3)."""


@dataclass(frozen=True, slots=True)
class Weighing:
    """How much a camera's word on a point counts.

    Measured as in :class:`l3ps.presets.Consensus`, where all together gain 17.7 mIoU and 31.8 thing PQ: without the
    occlusion test 17.1 and 30.2, without the edges 17.6 and 30.5, all depths alike 16.1 and 30.4, by label alone 17.0
    and 30.5, by probability alone 18.3 and 33.9 (but real recordings then lose a bus of few points and 2 IoU of cars).

    Attributes:
        occlusion: a point this share of its depth (and 0.5 m) behind the surface above and below it in the image gets
            no vote from that camera; None lets all vote, as published.
        edge: pixels of the network's output from a label edge within which a vote counts less, down to half on the
            edge itself; 0 counts all the same.
        near: metres of depth at which a vote counts half, nearer ones less: there a LiDAR puts hundreds of points on
            what is one look at one surface, and parallax and motion shift them by most pixels. 0 counts all the same.
        label: share of a vote that goes to the panoptic label, from which segments too small to be things are gone;
            the rest goes by the network's probabilities.
    """

    occlusion: float | None = 0.1
    edge: float = 6.0
    near: float = 8.0
    label: float = 0.5


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
    views: Iterable[View],
    weighing: Weighing = Weighing(),
) -> tuple[NDArray[np.uint8], NDArray[np.int32], Evidence]:
    """Label each point of a scan by the pixel it falls on; a later camera overwrites an earlier one.

    Instance ids are made unique over the scan's images, so that two objects in two cameras never share one. The
    evidence is not overwritten: cameras that see a point add up, each with its class probabilities.

    Args:
        xyz: (N, 3) float32, metres, lidar frame.
        views: the cameras in their order.
        weighing: what a vote counts, for the evidence alone.

    Returns:
        (N,) uint8 ``NUSCENES16`` class, 0 where no camera sees the point, (N,) int32 instance id, 0 = none, and the
        evidence.
    """
    semantic = np.zeros(len(xyz), dtype=np.uint8)
    instance = np.zeros(len(xyz), dtype=np.int32)
    gathered = _Ballot(len(xyz))
    taken = 0
    for image, lidar_to_camera, intrinsic in views:
        uv, depth, seen = project(xyz, lidar_to_camera, intrinsic, image.size)
        height, width = image.semantic.shape
        column = (uv[seen, 0] * (width / image.size[0])).astype(np.intp)
        row = (uv[seen, 1] * (height / image.size[1])).astype(np.intp)
        semantic[seen] = image.semantic[row, column]
        ids = image.instance[row, column]
        instance[seen] = np.where(ids > 0, ids + taken, 0)
        taken += int(image.instance.max(initial=0))

        weight = np.asarray(1 / (1 + (weighing.near / depth[seen]) ** 2), dtype=np.float32)
        if weighing.edge:
            weight *= _edge_weight(image.votes, weighing.edge)[row, column]
        if weighing.occlusion is not None:
            weight[is_hidden(uv[seen], depth[seen], intrinsic, image.size, weighing.occlusion)] = 0
        gathered.add(np.flatnonzero(seen), _probabilities(image, row, column, weighing.label), weight)
    return semantic, instance, gathered.evidence()


def is_hidden(
    uv: NDArray[np.float64],
    depth: NDArray[np.float64],
    intrinsic: NDArray[np.float64],
    size: tuple[int, int],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Which points lie clearly behind the surface that the camera sees at their place.

    The LiDAR looks from higher up than the camera and over what stands near; the points it finds behind there fall
    on pixels of the nearer thing. Its beams leave gaps in that surface, so it is looked for above *and* below the
    point: ground that rises to the horizon is nearer only below, a car in front is nearer on both sides.

    Args:
        uv: (n, 2) float64 pixel coordinates of points inside the image.
        depth: (n,) float64 metres.
        intrinsic: (3, 3) pixels.
        size: (width, height) in pixels.
        tolerance: share of a point's depth that the surface must be nearer, beside 0.5 m.

    Returns:
        (n,) bool.
    """
    cell = max(1.0, float(intrinsic[0, 0]) * _CELL)
    column, row = (uv / cell).astype(np.intp).T
    nearest = np.full((int(size[1] / cell) + 1, int(size[0] / cell) + 1), np.inf, dtype=np.float32)
    np.minimum.at(nearest, (row, column), depth.astype(np.float32))
    sides = nearest.copy()
    np.minimum(sides[:, 1:], nearest[:, :-1], out=sides[:, 1:])
    np.minimum(sides[:, :-1], nearest[:, 1:], out=sides[:, :-1])
    above, below = np.full_like(sides, np.inf), np.full_like(sides, np.inf)
    for step in range(1, _REACH + 1):
        np.minimum(above[step:], sides[:-step], out=above[step:])
        np.minimum(below[:-step], sides[step:], out=below[:-step])
    front = np.maximum(above, below)[row, column]
    return np.asarray(front < depth * (1 - tolerance) - 0.5, dtype=np.bool_)


_CELL = 0.006
"""Edge of a cell of the depth map in radians, about the horizontal step of the LiDARs in use (0.2° to 0.4°)."""
_REACH = 5
"""Cells above and below: 1.7°, more than the 1.3° between the beams of a 32-beam LiDAR."""


def _edge_weight(semantic: NDArray[np.uint8], reach: float) -> NDArray[np.float32]:
    """(h, w) float32: 1 from ``reach`` pixels off a label edge on, falling to half on it."""
    edge = np.zeros(semantic.shape, dtype=bool)
    for ahead, behind in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        differs = semantic[ahead] != semantic[behind]
        edge[ahead] |= differs
        edge[behind] |= differs
    if not edge.any():
        return np.ones(semantic.shape, dtype=np.float32)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    return np.asarray(np.clip(0.5 + 0.5 / reach * distance, 0, 1), dtype=np.float32)


def _probabilities(
    image: PanopticImage, row: NDArray[np.intp], column: NDArray[np.intp], label: float
) -> NDArray[np.float32]:
    """(n, 17) float32 vote of some pixels, adding up to 1; the label alone where the image has no scores."""
    certain = np.eye(len(NUSCENES16.classes), dtype=np.float32)[image.votes[row, column]]
    if image.scores is None:
        return certain
    return label * certain + (1 - label) * image.scores.at(row, column)


class _Ballot:
    """The cameras' votes on a scan's points as they come in."""

    def __init__(self, points: int) -> None:
        self._weight = np.zeros((points, len(NUSCENES16.classes)), dtype=np.float32)
        self._cameras = np.zeros(points, dtype=np.uint8)
        self._first = np.zeros(points, dtype=np.uint8)
        self._agree = np.ones(points, dtype=bool)

    def add(self, at: NDArray[np.intp], probability: NDArray[np.float32], weight: NDArray[np.float32]) -> None:
        """Count one camera's votes on the points ``at``; those of weight 0 do not see the point."""
        counts = weight > 0
        at, probability, weight = at[counts], probability[counts], weight[counts]
        choice = probability.argmax(axis=1).astype(np.uint8)
        again = self._cameras[at] > 0
        self._agree[at[again]] &= self._first[at[again]] == choice[again]
        self._first[at[~again]] = choice[~again]
        self._cameras[at] += 1
        self._weight[at] += probability * weight[:, None]

    def evidence(self) -> Evidence:
        """The heaviest candidates of each point."""
        order = np.argsort(-self._weight, axis=1, kind="stable")[:, :CANDIDATES]
        weight = np.take_along_axis(self._weight, order, axis=1)
        stored = np.minimum(np.rint(weight * ONE_VOTE), 255).astype(np.uint8)
        return Evidence(np.where(stored > 0, order, 0).astype(np.uint8), stored, self._cameras, self._agree)
