"""The ground: one gently winding street with kerbs, verges, pavements, islands and a side street.

Street frame: x along the street, y to the left, z up; z = 0 is the carriageway. Everything beyond the kerb lies one
kerb height higher. What covers the ground is a function of the place, evaluated exactly where a ray arrives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
Double = NDArray[np.float64]
X_MIN, X_MAX = -110.0, 210.0
"""Extent of the built street along x, metres; beyond it the surfaces simply go on."""
BIN = 0.5
"""Step of the tables along x, metres."""
RIGHT, LEFT = 0, 1


class Surface(IntEnum):
    """What covers the ground."""

    NONE = 0
    ROAD = 1
    SIDEWALK = 2
    TERRAIN = 3
    OTHER = 4


def bins() -> int:
    """Number of steps of the tables along x."""
    return int((X_MAX - X_MIN) / BIN)


def span(start: float, stop: float) -> slice:
    """The table entries of a stretch of street."""
    return slice(max(0, round((start - X_MIN) / BIN)), max(0, round((stop - X_MIN) / BIN)))


@dataclass(frozen=True)
class Street:
    """Geometry of the ground.

    Attributes:
        amplitude, wavenumber, phase: the centre line is y = amplitude · sin(wavenumber · x + phase).
        half_width: centre line to kerb, metres.
        kerb: height of the kerb, metres.
        verge, walk: width of grass strip and pavement, (right, left), metres.
        cross_x, cross_half: middle and half width of the side street, metres along x.
        lots: (2, bins) surface behind the pavement, by side.
        driveways: (2, bins) where a drive crosses the pavement.
        island: (bins,) half width of the traffic island in the middle, 0 where there is none.
    """

    amplitude: float
    wavenumber: float
    phase: float
    half_width: float
    kerb: float
    verge: tuple[float, float]
    walk: tuple[float, float]
    cross_x: float
    cross_half: float
    lots: NDArray[np.uint8] = field(repr=False)
    driveways: NDArray[np.bool_] = field(repr=False)
    island: Float = field(repr=False)

    def place(self, x: Double, offset: Double) -> tuple[Double, Double, Double]:
        """Street positions of points beside the centre line.

        Args:
            x: (n,) where along the street, metres.
            offset: (n,) to the left of the centre line, metres.

        Returns:
            (n,) x and y in metres and (n,) the street's heading there in radians.
        """
        angle = self.wavenumber * x + self.phase
        heading = np.arctan(self.amplitude * self.wavenumber * np.cos(angle))
        y = self.amplitude * np.sin(angle)
        return x - offset * np.sin(heading), y + offset * np.cos(heading), heading

    def offset(self, x: Float, y: Float) -> Float:
        """(n,) signed distance from the centre line, positive to the left (first order in the curvature)."""
        angle = np.float32(self.wavenumber) * x + np.float32(self.phase)
        slope = np.float32(self.amplitude * self.wavenumber) * np.cos(angle)
        return np.asarray((y - np.float32(self.amplitude) * np.sin(angle)) / np.sqrt(1 + slope * slope))

    def surface(self, x: Float, y: Float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """What covers the ground and whether it lies above the kerb.

        Args:
            x, y: (n,) places in the street frame, metres.

        Returns:
            (n,) uint8 of :class:`Surface` and (n,) bool.
        """
        offset = self.offset(x, y)
        left = (offset > 0).astype(np.intp)
        away = np.abs(offset)
        at = np.clip(((x - np.float32(X_MIN)) / np.float32(BIN)).astype(np.intp), 0, bins() - 1)
        beyond = away - np.float32(self.half_width)
        verge = np.asarray(self.verge, dtype=np.float32)[left]
        edge = verge + np.asarray(self.walk, dtype=np.float32)[left]
        drive = self.driveways[left, at]
        kind = np.where(beyond < edge, np.uint8(Surface.SIDEWALK), self.lots[left, at])
        kind[(beyond < verge) & (verge > 0)] = Surface.TERRAIN
        kind[drive & (beyond < edge + 6)] = Surface.ROAD
        across = np.abs(x - np.float32(self.cross_x))
        kind[(across < self.cross_half + self.walk[0]) & (beyond >= 0)] = Surface.SIDEWALK
        on_island = away < self.island[at]
        low = ((beyond < 0) | (across < self.cross_half)) & ~on_island
        kind[low] = Surface.ROAD
        kind[on_island] = Surface.OTHER
        return kind, ~low


@dataclass(frozen=True)
class GroundHits:
    """Where rays meet the ground.

    Attributes:
        depth: (n,) float32 multiple of the ray; infinite where the ground is not met.
        kind: (n,) uint8 of :class:`Surface`.
        face: (n,) bool, True on the upright face of a kerb.
    """

    depth: Float
    kind: NDArray[np.uint8]
    face: NDArray[np.bool_]


def meet_ground(street: Street, origin: NDArray[np.float64], rays: Float) -> GroundHits:
    """Intersect rays with the two levels of the ground and the kerb between them.

    Args:
        street: the ground.
        origin: (3,) where the rays start, street frame, above the kerb.
        rays: (3, n) directions, street frame.
    """
    start = origin.astype(np.float32)
    depth = np.full(rays.shape[1], np.inf, dtype=np.float32)
    kind = np.zeros(rays.shape[1], dtype=np.uint8)
    face = np.zeros(rays.shape[1], dtype=bool)
    down = np.flatnonzero(rays[2] < -1e-4)
    ray = rays[:, down]
    upper = (np.float32(street.kerb) - start[2]) / ray[2]
    surface, raised = street.surface(start[0] + upper * ray[0], start[1] + upper * ray[1])
    depth[down], kind[down] = upper, surface

    lower = np.flatnonzero(~raised)
    ray, above = ray[:, lower], upper[lower]
    reach = -start[2] / ray[2]
    surface, raised = street.surface(start[0] + reach * ray[0], start[1] + reach * ray[1])
    buried = np.flatnonzero(raised)  # passed over the carriageway but would come out under a pavement: met the kerb
    if len(buried):
        near, far, ray = above[buried], reach[buried].copy(), ray[:, buried]
        for _ in range(6):
            middle = (near + far) / 2
            inside = street.surface(start[0] + middle * ray[0], start[1] + middle * ray[1])[1]
            near, far = np.where(inside, near, middle), np.where(inside, middle, far)
        reach[buried] = far
        face[down[lower[buried]]] = True
    depth[down[lower]], kind[down[lower]] = reach, surface
    return GroundHits(depth, kind, face)
