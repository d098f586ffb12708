"""Cars, trucks, buses, trailers, excavators, motorcycles and bicycles."""

from __future__ import annotations

import numpy as np

from .parts import Color, Look, Part, ball, beam, box, jitter, post, wheel
from .people import rider
from .shapes import Kind

PAINTS: tuple[Color, ...] = (
    (0.72, 0.73, 0.74), (0.45, 0.46, 0.48), (0.06, 0.06, 0.07), (0.14, 0.15, 0.17), (0.55, 0.08, 0.07),
    (0.08, 0.16, 0.4), (0.3, 0.36, 0.42), (0.85, 0.85, 0.83), (0.2, 0.25, 0.2), (0.5, 0.42, 0.3), (0.65, 0.45, 0.1),
)  # fmt: skip
DARK: Color = (0.05, 0.05, 0.055)
STEEL: Color = (0.35, 0.36, 0.37)
Size = tuple[float, float, float]
"""Width, length, height in metres, the order of a nuScenes box."""


def _paint(rng: np.random.Generator) -> Color:
    return jitter(rng, PAINTS[int(rng.integers(len(PAINTS)))], 0.04)


def _lamps(length: float, width: float, z: float) -> list[Part]:
    """Head and tail lamps, each a thin box on a corner."""
    lamps = []
    for side in (-1, 1):
        y = side * (width / 2 - 0.25)
        lamps.append(
            box((length / 2 - 0.03, length / 2 + 0.01), (y - 0.17, y + 0.17), (z, z + 0.14), (0.85, 0.85, 0.8))
        )
        lamps.append(
            box((-length / 2 - 0.01, -length / 2 + 0.03), (y - 0.16, y + 0.16), (z, z + 0.17), (0.5, 0.03, 0.03),
                reflect=0.9)
        )  # fmt: skip
    return lamps


def car(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A hatchback, saloon, estate, off-roader or van."""
    style = int(rng.integers(5))
    length, width, height = [
        (3.9, 1.72, 1.5), (4.7, 1.82, 1.45), (4.65, 1.82, 1.5), (4.6, 1.9, 1.72), (5.0, 1.95, 1.98),
    ][style]  # fmt: skip
    length, width, height = length + rng.normal(0, 0.12), width + rng.normal(0, 0.03), height + rng.normal(0, 0.04)
    paint = _paint(rng)
    shoulder = (0.52 + 0.05 * (style >= 3)) * height + 0.05
    front, rear = [(0.22, -0.47), (0.2, -0.3), (0.2, -0.48), (0.18, -0.47), (0.3, -0.49)][style]
    lean = [0.75, 1.0, 0.75, 0.65, 0.5][style]
    half = (front - rear) * length / 2
    middle = (front + rear) * length / 2
    parts = [
        box((-length / 2, length / 2), (-width / 2, width / 2), (0.32, shoulder), paint, Look.PAINT, 0.45),
        box((-length / 2 + 0.05, length / 2 - 0.05), (-width / 2 + 0.04, width / 2 - 0.04), (0.2, 0.33), DARK),
        Part(
            Kind.WEDGE, (middle, 0.0, (shoulder + height) / 2), (half, width * 0.44, (height - shoulder) / 2), paint,
            Look.CABIN, 0.3, taper=lean,
        ),
        *_lamps(length, width, shoulder - 0.25),
        box((-length / 2 - 0.02, -length / 2), (-0.26, 0.26), (0.45, 0.57), (0.8, 0.8, 0.75), reflect=0.95),
    ]  # fmt: skip
    for x in (-0.3 * length, 0.31 * length):
        parts += [wheel(x, side * (width / 2 - 0.095), 0.33, 0.22) for side in (-1, 1)]
    return parts, (width, length, height)


def truck(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A lorry: cab and box body, tipper or flatbed."""
    length, width, height = 6.5 + 2.5 * rng.random(), 2.3 + 0.2 * rng.random(), 2.9 + 0.7 * rng.random()
    paint, body = _paint(rng), jitter(rng, ((0.75, 0.74, 0.7), (0.4, 0.42, 0.45), _paint(rng))[int(rng.integers(3))])
    cab = length / 2 - 1.9
    style = int(rng.integers(3))
    top = (height, 1.9, 1.5)[style]
    parts = [
        box((-length / 2, length / 2 - 0.1), (-width * 0.38, width * 0.38), (0.5, 0.95), DARK),
        box((cab, length / 2), (-width / 2, width / 2), (0.55, 1.55), paint, Look.PAINT, 0.45),
        Part(Kind.WEDGE, (cab + 0.95, 0, 2.05), (0.95, width * 0.49, 0.5), paint, Look.CABIN, 0.4, taper=0.35),
        box((-length / 2, cab - 0.25), (-width / 2, width / 2), (0.95, top), body, Look.SLATS if style else Look.PAINT),
        *_lamps(length, width, 0.7),
    ]
    for x in (-length / 2 + 1.2, -length / 2 + 2.4, length / 2 - 1.1):
        parts += [wheel(x, side * (width / 2 - 0.135), 0.48, 0.3) for side in (-1, 1)]
    return parts, (width, length, max(top, 2.55))


def bus(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A city bus."""
    length, width, height = 10.5 + 1.8 * rng.random(), 2.55, 3.05 + 0.15 * rng.random()
    paint = _paint(rng)
    stripe = _paint(rng)
    parts = [
        box((-length / 2, length / 2), (-width / 2, width / 2), (0.35, 1.15), stripe, Look.PAINT),
        box((-length / 2, length / 2), (-width / 2, width / 2), (1.15, height), paint, Look.COACH, 0.35),
        box((-length * 0.3, length * 0.2), (-0.8, 0.8), (height, height + 0.22), (0.6, 0.6, 0.6)),
        *_lamps(length, width, 0.6),
    ]
    for x in (-length * 0.27, length * 0.3):
        parts += [wheel(x, side * (width / 2 - 0.125), 0.48, 0.28) for side in (-1, 1)]
    return parts, (width, length, height + 0.22)


def trailer(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A box or flat trailer with its drawbar."""
    length, width, height = 4.5 + 4 * rng.random(), 2.2 + 0.3 * rng.random(), 2.2 + 1.1 * rng.random()
    body = jitter(rng, ((0.7, 0.7, 0.68), (0.35, 0.4, 0.38), (0.5, 0.25, 0.15))[int(rng.integers(3))])
    parts = [
        box((-length / 2, length / 2 - 0.9), (-width / 2, width / 2), (0.85, height), body, Look.SLATS),
        box((-length / 2, length / 2 - 0.9), (-width * 0.4, width * 0.4), (0.6, 0.85), DARK),
        box((length / 2 - 0.9, length / 2), (-0.08, 0.08), (0.55, 0.7), STEEL),
        post(length / 2 - 0.7, 0.25, (0.0, 0.6), 0.05, STEEL),
    ]
    for x in (-length * 0.28, -length * 0.28 + 0.95):
        parts += [wheel(x, side * (width / 2 - 0.11), 0.4, 0.25) for side in (-1, 1)]
    return parts, (width, length, height)


def excavator(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A construction vehicle: tracks, turned house, boom, stick and bucket."""
    paint = jitter(rng, ((0.75, 0.5, 0.06), (0.7, 0.38, 0.05), (0.55, 0.5, 0.4))[int(rng.integers(3))])
    reach = 2.6 + rng.random()
    parts = [
        box((-1.8, 1.8), (-1.25, -0.75), (0.0, 0.8), DARK, Look.SLATS, 0.1),
        box((-1.8, 1.8), (0.75, 1.25), (0.0, 0.8), DARK, Look.SLATS, 0.1),
        box((-1.9, 1.2), (-1.2, 1.2), (0.85, 1.75), paint, Look.PAINT),
        box((-0.1, 1.3), (0.2, 1.2), (1.7, 2.75), paint, Look.CABIN),
        beam((0.6, -0.3, 1.5), (0.6 + reach * 0.6, -0.3, 3.6), 0.2, paint),
        beam((0.6 + reach * 0.6, -0.3, 3.6), (0.8 + reach, -0.3, 1.4), 0.15, paint),
        box((0.5 + reach, 1.2 + reach), (-0.75, 0.15), (0.6, 1.4), (0.25, 0.24, 0.23)),
    ]
    # The box is centred on the machine, so everything moves back by half of what the boom sticks out.
    shift = (1.2 + reach - 1.9) / 2
    moved = [
        Part(p.kind, (p.center[0] - shift, p.center[1], p.center[2]), p.half, p.color, p.look, p.reflect, p.angles)
        for p in parts
    ]
    return moved, (2.5, 3.1 + reach, 3.75)


def motorcycle(rng: np.random.Generator, ridden: bool) -> tuple[list[Part], Size]:
    """A motorcycle or scooter."""
    paint = _paint(rng)
    parts = [
        wheel(-0.65, 0.0, 0.31, 0.14),
        wheel(0.68, 0.0, 0.31, 0.12),
        box((-0.5, 0.45), (-0.16, 0.16), (0.35, 0.72), paint, Look.PAINT),
        box((-0.85, 0.05), (-0.14, 0.14), (0.7, 0.85), DARK),
        ball(0.15, 0.0, 0.85, (0.28, 0.17, 0.15), paint),
        beam((0.68, 0.0, 0.31), (0.42, 0.0, 1.0), 0.05, STEEL),
        box((0.36, 0.44), (-0.36, 0.36), (0.98, 1.04), DARK),
    ]
    if ridden:
        parts += rider(rng, seat=0.8, helmet=True)
    return parts, (0.78, 2.1, 1.68 if ridden else 1.1)


def bicycle(rng: np.random.Generator, ridden: bool) -> tuple[list[Part], Size]:
    """A bicycle; with its rider it is still one object of the class, as in nuScenes."""
    paint = _paint(rng)
    parts = [
        wheel(-0.52, 0.0, 0.34, 0.06, 0.2),
        wheel(0.54, 0.0, 0.34, 0.06, 0.2),
        beam((-0.52, 0, 0.34), (-0.1, 0, 0.78), 0.04, paint),
        beam((-0.1, 0, 0.32), (-0.14, 0, 0.92), 0.04, paint),
        beam((-0.1, 0, 0.4), (0.42, 0, 0.82), 0.045, paint),
        beam((0.54, 0, 0.34), (0.38, 0, 1.0), 0.04, paint),
        box((0.34, 0.4), (-0.28, 0.28), (0.98, 1.03), DARK),
        box((-0.3, 0.0), (-0.07, 0.07), (0.9, 0.97), DARK),
    ]
    if ridden:
        parts += rider(rng, seat=0.95, helmet=bool(rng.random() < 0.5))
    return parts, (0.62, 1.76, 1.75 if ridden else 1.06)
