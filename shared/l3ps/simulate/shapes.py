"""Solids and how rays meet them.

A world is a few thousand boxes, wedges, frustums and ellipsoids. Each is intersected only within the window of rays
that can reach its bounding box, all rays of a window at once; nearer hits win by a depth buffer. Every sensor that
can say which rays a box may concern (:class:`RayGrid`) is served by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .textures import SIZE

Float = NDArray[np.float32]
Double = NDArray[np.float64]
PARALLEL = np.float32(1e-9)
"""Keeps a ray that runs parallel to a face from dividing by zero; lost in rounding for every other."""


class Kind(IntEnum):
    """What a solid is."""

    BOX = 0
    WEDGE = 1
    """A box whose front and rear lean inwards by ``taper`` metres from bottom to top (a car's cabin)."""
    FRUSTUM = 2
    """Round, axis along local z; the radius shrinks by the share ``taper`` from bottom to top."""
    ELLIPSOID = 3
    CROWN = 4
    """An ellipsoid with holes and a ragged outline (foliage)."""


@dataclass(frozen=True)
class Solids:
    """Many solids as parallel arrays, in the street frame.

    Attributes:
        kind: (M,) uint8 of :class:`Kind`.
        center: (M, 3) float64, metres.
        rotation: (M, 3, 3) float64, solid → street.
        half: (M, 3) float64, half extents in metres; of a frustum (radius, radius, half height).
        taper: (M,) float64, see :class:`Kind`.
        owner: (M,) int32, index of the object the solid is part of.
    """

    kind: NDArray[np.uint8]
    center: Double
    rotation: Double
    half: Double
    taper: Double
    owner: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.kind)

    def corners(self) -> Double:
        """(M, 8, 3) corners of the bounding boxes, street frame."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
        turned = np.einsum("mij,mkj->mki", self.rotation, signs[None] * self.half[:, None])
        return np.asarray(turned + self.center[:, None])


EDGES = np.array([(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)])
"""The twelve edges of a box in the corner order of :meth:`Solids.corners`."""


@dataclass(frozen=True)
class Windows:
    """Which rays may meet which solid; a solid may appear twice (across the seam of a spinning sensor).

    Attributes:
        solid: (W,) index of the solid.
        rows, columns: (W, 2) half-open ranges of the ray grid.
        near: (W,) lower bound of the depth at which the solid can be hit.
    """

    solid: NDArray[np.intp]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    near: Double


class RayGrid(Protocol):
    """A sensor as rows and columns of rays that share one origin."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""

    @property
    def origin(self) -> Double:
        """(3,) where the rays start, street frame."""

    @property
    def rotation(self) -> Double:
        """(3, 3) sensor → street."""

    def windows(self, corners: Double) -> Windows:
        """Windows of the boxes whose (M, 8, 3) corners are given in the sensor frame."""

    def directions(self, matrix: Double, rows: slice, columns: slice) -> Float:
        """(3, h, w) ray directions of a window, turned by a (3, 3) matrix from the sensor frame.

        Directions need not have length one: depth is measured in their multiples.
        """


@dataclass(frozen=True)
class Hits:
    """What each ray of a grid met first.

    Attributes:
        depth: (H, W) float32 multiple of the ray direction; infinite where nothing was met.
        solid: (H, W) int32 index of the solid; -1 where none.
    """

    depth: Float
    solid: NDArray[np.int32]


def cast(solids: Solids, grid: RayGrid, leaves: Float) -> Hits:
    """The nearest solid along every ray.

    Args:
        solids: what can be hit.
        grid: the rays.
        leaves: (SIZE, SIZE) noise tile that shapes the holes of crowns.
    """
    depth = np.full(grid.shape, np.inf, dtype=np.float32)
    solid = np.full(grid.shape, -1, dtype=np.int32)
    windows = grid.windows((solids.corners() - grid.origin) @ grid.rotation)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for w in np.argsort(windows.near, kind="stable"):
            rows, columns = slice(*windows.rows[w]), slice(*windows.columns[w])
            behind = depth[rows, columns]
            if windows.near[w] > behind.max():
                continue  # hidden entirely by nearer solids
            i = int(windows.solid[w])
            to_solid = solids.rotation[i].T
            origin = (to_solid @ (grid.origin - solids.center[i])).astype(np.float32)
            rays = grid.directions(to_solid @ grid.rotation, rows, columns)
            reach = _intersect(int(solids.kind[i]), origin, rays, solids.half[i], float(solids.taper[i]), leaves, i)
            closer = (reach < behind) & (reach > 0)
            np.copyto(behind, reach, where=closer)
            np.copyto(solid[rows, columns], np.int32(i), where=closer)
    return Hits(depth, solid)


def _intersect(kind: int, origin: Float, rays: Float, half: Double, taper: float, leaves: Float, salt: int) -> Float:
    """(h, w) depth along each ray in the solid's own frame; not finite or not positive where it is missed."""
    size = half.astype(np.float32)
    if kind == Kind.BOX:
        return _box(origin, rays, size)
    if kind == Kind.WEDGE:
        return _wedge(origin, rays, size, taper)
    if kind == Kind.FRUSTUM:
        return _frustum(origin, rays, size, taper)
    scaled = rays / size[:, None, None]
    reach = _sphere(origin / size, scaled)
    return _ragged(reach, origin / size, scaled, leaves, salt) if kind == Kind.CROWN else reach


def _missed(reach: Float, hit: NDArray[np.bool_]) -> Float:
    return np.where(hit, reach, np.float32(np.inf))


def _box(origin: Float, rays: Float, half: Float) -> Float:
    """Slab test (Kay and Kajiya 1986), all three slabs at once."""
    inverse = 1 / (rays + PARALLEL)
    middle = -origin[:, None, None] * inverse
    spread = half[:, None, None] * np.abs(inverse)
    entry = (middle - spread).max(axis=0)
    return _missed(entry, entry <= (middle + spread).min(axis=0))


def _wedge(origin: Float, rays: Float, half: Float, taper: float) -> Float:
    """Two slabs and two leaning planes: |x| ≤ half_x − taper · (z + half_z) / (2 half_z)."""
    inverse = 1 / (rays[1:] + PARALLEL)
    middle = -origin[1:, None, None] * inverse
    spread = half[1:, None, None] * np.abs(inverse)
    entry, leave = (middle - spread).max(axis=0), (middle + spread).min(axis=0)
    lean = np.float32(taper / (2 * half[2]))
    edge = half[0] - np.float32(taper / 2)
    for sign in (np.float32(1), np.float32(-1)):
        speed = sign * rays[0] + lean * rays[2]
        reach = (edge - sign * origin[0] - lean * origin[2]) / speed
        entering = speed < 0
        entry = np.maximum(entry, np.where(entering, reach, -np.inf))
        leave = np.minimum(leave, np.where(entering, np.inf, reach))
    return _missed(entry, entry <= leave)


def _frustum(origin: Float, rays: Float, half: Float, taper: float) -> Float:
    """Side by the quadratic of a cone, then the two lids."""
    radius, height = half[0], half[2]
    slope = np.float32(-radius * taper / (2 * height))
    waist = np.float32(radius * (1 - taper / 2)) + slope * origin[2]
    a = rays[0] ** 2 + rays[1] ** 2 - (slope * rays[2]) ** 2
    b = origin[0] * rays[0] + origin[1] * rays[1] - slope * waist * rays[2]
    c = origin[0] ** 2 + origin[1] ** 2 - waist**2
    root = np.sqrt(b * b - a * c)  # nan where the ray misses; every comparison below is then false
    side = (-b - root) / a
    side = _missed(side, np.abs(origin[2] + side * rays[2]) <= height)
    lid, shrink = (height, 1 - taper) if origin[2] > 0 else (-height, 1.0)
    reach = (np.float32(lid) - origin[2]) / rays[2]
    off = (origin[0] + reach * rays[0]) ** 2 + (origin[1] + reach * rays[1]) ** 2
    flat = _missed(reach, (off <= np.float32((radius * shrink) ** 2)) & (reach > 0))
    return np.minimum(np.where(side > 0, side, np.float32(np.inf)), flat)


def _sphere(origin: Float, rays: Float) -> Float:
    """Unit sphere."""
    a = (rays * rays).sum(axis=0)
    b = np.tensordot(origin, rays, axes=1)
    reach = (-b - np.sqrt(b * b - a * (origin @ origin - 1))) / a
    return _missed(reach, reach > 0)


def _ragged(reach: Float, origin: Float, rays: Float, leaves: Float, salt: int) -> Float:
    """Let rays through a crown where its leaves are thin, more so towards the outline."""
    hit = np.isfinite(reach)
    if not hit.any():
        return reach
    along = rays[:, hit]
    point = origin[:, None] + reach[hit] * along
    facing = -(point * along).sum(axis=0) / np.sqrt((along * along).sum(axis=0))
    column = ((point[0] * 29 + point[2] * 13) + salt * 31).astype(np.int32) & (SIZE - 1)
    row = ((point[1] * 27 + point[2] * 19) + salt * 17).astype(np.int32) & (SIZE - 1)
    reach[hit] = np.where(leaves[row, column] > 1.0 - 2.6 * facing, reach[hit], np.float32(np.inf))
    return reach
