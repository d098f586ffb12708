"""Where on a solid a ray has landed: its own coordinates there, the surface's direction and texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .shapes import Kind, Solids

Float = NDArray[np.float32]


@dataclass(frozen=True)
class Spots:
    """Places on solids, one a ray.

    Attributes:
        local: (n, 3) float32 coordinates in the solid's frame, metres.
        normal: (n, 3) float32 outward unit normal, street frame.
        u: (n,) float32 horizontal texture coordinate, metres.
        v: (n,) float32 height above the solid's underside, or the second coordinate on a level face, metres.
        level: (n,) bool, True on a face that looks up or down in the solid's frame.
        x_face: (n,) bool, True on a front or rear face of a box.
    """

    local: Float
    normal: Float
    u: Float
    v: Float
    level: NDArray[np.bool_]
    x_face: NDArray[np.bool_]


def locate(solids: Solids, index: NDArray[np.int32], points: Float) -> Spots:
    """Surface coordinates and normals of hit points.

    Args:
        solids: what was hit.
        index: (n,) which solid each point lies on.
        points: (n, 3) float32, street frame.
    """
    rotation = solids.rotation.astype(np.float32)[index]
    half = solids.half.astype(np.float32)[index]
    kind = solids.kind[index]
    local = np.einsum("nij,ni->nj", rotation, points - solids.center.astype(np.float32)[index])
    flat_sided = kind <= Kind.WEDGE
    lean = np.where(kind == Kind.WEDGE, solids.taper.astype(np.float32)[index] / (2 * half[:, 2]), np.float32(0))
    share = np.abs(local) / half
    share[:, 0] += lean * (local[:, 2] + half[:, 2]) / half[:, 0]
    axis = share.argmax(axis=1)
    towards = np.sign(local)

    normal = local / (half * half)  # ellipsoids
    round_side = kind == Kind.FRUSTUM
    lid = round_side & (share[:, 2] > 0.999)
    normal[round_side, 2] = 0
    normal[lid] = 0
    normal[lid, 2] = towards[lid, 2]
    boxes = np.flatnonzero(flat_sided)
    normal[boxes] = 0
    normal[boxes, axis[boxes]] = towards[boxes, axis[boxes]]
    leaning = flat_sided & (axis == 0)
    normal[leaning, 2] = lean[leaning]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + np.float32(1e-9)

    level = (flat_sided & (axis == 2)) | lid
    x_face = flat_sided & (axis == 0)
    angle = np.arctan2(local[:, 1], local[:, 0]) * half[:, 0]
    u = np.where(flat_sided | lid, np.where(x_face, local[:, 1], local[:, 0]), angle)
    v = np.where(level, local[:, 1], local[:, 2] + half[:, 2])
    return Spots(local, np.einsum("nij,nj->ni", rotation, normal), u, v, level, x_face)
