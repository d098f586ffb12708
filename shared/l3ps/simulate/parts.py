"""Building blocks of objects: a part is a solid with a look, an object is a list of parts around its own origin.

Object frame: origin on the ground below the middle, x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from .shapes import Kind

Color = tuple[float, float, float]


class Look(IntEnum):
    """How a surface is painted; see :mod:`.shading`."""

    PLAIN = 0
    PAINT = 1
    """Lacquer: reflects the sky, dirtier towards the ground."""
    CABIN = 2
    """Lacquer with a band of windows."""
    COACH = 3
    """Lacquer with a row of windows divided by pillars."""
    FACADE = 4
    BRICK = 5
    LEAVES = 6
    BARK = 7
    CLOTH = 8
    STRIPES = 9
    SLATS = 10
    """Boards or corrugated metal: fences, containers, shutters."""
    SIGN = 11


@dataclass(frozen=True)
class Part:
    """One solid of an object.

    Attributes:
        kind: its shape.
        center: (x, y, z) in the object frame, metres.
        half: half extents; of a frustum (radius, radius, half height).
        color: linear RGB in 0..1.
        look: how it is painted.
        reflect: share of laser light that comes back, 0..1.
        angles: yaw, pitch, roll in radians.
        taper: see :class:`~.shapes.Kind`.
    """

    kind: Kind
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    color: Color
    look: Look = Look.PLAIN
    reflect: float = 0.4
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    taper: float = 0.0


def turn(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> NDArray[np.float64]:
    """(3, 3) rotation Rz(yaw) · Ry(pitch) · Rx(roll)."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def box(
    x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], color: Color, look: Look = Look.PLAIN,
    reflect: float = 0.4,
) -> Part:  # fmt: skip
    """A box by its extents along each axis."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    middle, half = (low + high) / 2, (high - low) / 2
    return Part(Kind.BOX, tuple(middle), tuple(half), color, look, reflect)


def post(
    x: float, y: float, z: tuple[float, float], radius: float, color: Color, look: Look = Look.PLAIN,
    reflect: float = 0.4, taper: float = 0.0,
) -> Part:  # fmt: skip
    """An upright frustum by its foot and extent in height."""
    half = (radius, radius, (z[1] - z[0]) / 2)
    return Part(Kind.FRUSTUM, (x, y, (z[0] + z[1]) / 2), half, color, look, reflect, taper=taper)


def ball(
    x: float, y: float, z: float, half: tuple[float, float, float], color: Color, look: Look = Look.PLAIN,
    kind: Kind = Kind.ELLIPSOID, reflect: float = 0.4,
) -> Part:  # fmt: skip
    """An ellipsoid, or with ``kind=Kind.CROWN`` a ball of leaves."""
    return Part(kind, (x, y, z), half, color, look, reflect)


def wheel(x: float, y: float, radius: float, width: float, reflect: float = 0.08) -> Part:
    """A tyre standing on the ground, its axle along y."""
    half = (radius, radius, width / 2)
    return Part(Kind.FRUSTUM, (x, y, radius), half, (0.04, 0.04, 0.045), Look.PLAIN, reflect, (0, 0, np.pi / 2))


def beam(
    start: tuple[float, float, float], stop: tuple[float, float, float], radius: float, color: Color,
    look: Look = Look.PLAIN, reflect: float = 0.4,
) -> Part:  # fmt: skip
    """A round bar between two points."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(stop, dtype=np.float64)
    axis = b - a
    length = float(np.linalg.norm(axis))
    yaw, pitch = np.arctan2(axis[1], axis[0]), np.arccos(np.clip(axis[2] / length, -1, 1))
    half = (radius, radius, length / 2)
    return Part(Kind.FRUSTUM, tuple((a + b) / 2), half, color, look, reflect, (float(yaw), float(pitch), 0.0))


def jitter(rng: np.random.Generator, color: Color, amount: float = 0.05) -> Color:
    """A colour near the given one: common brightness and a little tint."""
    shade = 1 + rng.normal(0, amount * 2)
    r, g, b = np.clip(np.asarray(color) * shade + rng.normal(0, amount * 0.3, 3), 0.02, 0.95)
    return float(r), float(g), float(b)
