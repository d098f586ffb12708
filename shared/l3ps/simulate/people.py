"""Pedestrians and riders."""

from __future__ import annotations

import numpy as np

from .parts import Color, Look, Part, ball, beam, box, jitter, post

SKIN: tuple[Color, ...] = ((0.62, 0.45, 0.36), (0.45, 0.3, 0.22), (0.25, 0.16, 0.11))
CLOTHES: tuple[Color, ...] = (
    (0.08, 0.08, 0.1), (0.12, 0.15, 0.28), (0.4, 0.1, 0.1), (0.55, 0.53, 0.48), (0.2, 0.26, 0.18), (0.35, 0.27, 0.2),
    (0.7, 0.68, 0.66), (0.6, 0.5, 0.12), (0.28, 0.3, 0.33),
)  # fmt: skip
Size = tuple[float, float, float]


def _cloth(rng: np.random.Generator) -> Color:
    return jitter(rng, CLOTHES[int(rng.integers(len(CLOTHES)))], 0.06)


def pedestrian(rng: np.random.Generator, child: bool = False, worker: bool = False) -> tuple[list[Part], Size]:
    """A person on foot, mid-stride or standing; workers wear orange."""
    s = (0.66 if child else 1.0) * (1 + 0.05 * float(rng.normal()))
    stride = 0.28 * float(rng.random()) * s
    top: Color = (0.85, 0.35, 0.05) if worker else _cloth(rng)
    trousers, skin = _cloth(rng), SKIN[int(rng.integers(len(SKIN)))]
    hip, shoulder = 0.86 * s, 1.46 * s
    swing = stride * 0.8
    parts = [
        beam((stride, 0.1 * s, 0.0), (0.0, 0.09 * s, hip), 0.085 * s, trousers, Look.CLOTH),
        beam((-stride, -0.1 * s, 0.0), (0.0, -0.09 * s, hip), 0.085 * s, trousers, Look.CLOTH),
        post(0.0, 0.0, (hip - 0.06, shoulder), 0.2 * s, top, Look.CLOTH, taper=0.12),
        beam((0.0, 0.24 * s, shoulder - 0.04), (-swing, 0.27 * s, 0.85 * s), 0.06 * s, top, Look.CLOTH),
        beam((0.0, -0.24 * s, shoulder - 0.04), (swing, -0.27 * s, 0.85 * s), 0.06 * s, top, Look.CLOTH),
        ball(0.02, 0.0, 1.62 * s, (0.11 * s, 0.095 * s, 0.13 * s), skin),
        ball(-0.01, 0.0, 1.67 * s, (0.115 * s, 0.1 * s, 0.1 * s), (0.8, 0.6, 0.1) if worker else (0.1, 0.07, 0.05)),
    ]
    if rng.random() < 0.3:
        parts.append(box((-0.36 * s, -0.14 * s), (-0.16 * s, 0.16 * s), (1.0 * s, 1.42 * s), _cloth(rng), Look.CLOTH))
    return parts, (0.68 * s, 0.82 * s, 1.78 * s)


def rider(rng: np.random.Generator, seat: float, helmet: bool) -> list[Part]:
    """Who sits on a two-wheeler, leaning forward."""
    top, trousers, skin = _cloth(rng), _cloth(rng), SKIN[int(rng.integers(len(SKIN)))]
    return [
        beam((-0.15, 0.0, seat), (0.1, 0.0, seat + 0.5), 0.19, top, Look.CLOTH),
        beam((-0.12, 0.1, seat), (0.12, 0.13, seat - 0.5), 0.09, trousers, Look.CLOTH),
        beam((-0.12, -0.1, seat), (0.16, -0.13, seat - 0.35), 0.09, trousers, Look.CLOTH),
        beam((0.08, 0.2, seat + 0.42), (0.4, 0.24, seat + 0.08), 0.055, top, Look.CLOTH),
        beam((0.08, -0.2, seat + 0.42), (0.4, -0.24, seat + 0.08), 0.055, top, Look.CLOTH),
        ball(0.14, 0.0, seat + 0.66, (0.11, 0.095, 0.13), _cloth(rng) if helmet else skin),
    ]
