"""What stands still: houses, walls, trees, poles, signs, cones, barriers."""

from __future__ import annotations

import numpy as np

from .parts import Color, Look, Part, ball, beam, box, jitter, post
from .shapes import Kind

PLASTER: tuple[Color, ...] = (
    (0.55, 0.5, 0.42), (0.48, 0.46, 0.44), (0.38, 0.22, 0.17), (0.62, 0.6, 0.56), (0.5, 0.4, 0.28), (0.3, 0.32, 0.34),
    (0.42, 0.47, 0.42),
)  # fmt: skip
LEAF: Color = (0.13, 0.22, 0.06)
METAL: Color = (0.33, 0.34, 0.34)
Size = tuple[float, float, float]


def _wall_color(rng: np.random.Generator) -> Color:
    return jitter(rng, PLASTER[int(rng.integers(len(PLASTER)))], 0.06)


def _leaf_color(rng: np.random.Generator) -> Color:
    season = float(rng.random())
    return jitter(rng, (LEAF[0] + 0.12 * season**3, LEAF[1], LEAF[2]), 0.1)


def house(rng: np.random.Generator, length: float, depth: float) -> list[Part]:
    """A building, its front towards −y, with steps, balconies, a shop front or bays.

    Args:
        rng: source of style.
        length: extent along x, metres.
        depth: extent along y, metres.
    """
    height = 5 + 13 * float(rng.random()) ** 1.5
    color, look = _wall_color(rng), Look.FACADE if rng.random() < 0.65 else Look.BRICK
    front = -depth / 2
    parts = [box((-length / 2, length / 2), (front, depth / 2), (-0.5, height), color, look, 0.35)]
    if rng.random() < 0.6:  # plinth
        parts.append(
            box(
                (-length / 2, length / 2),
                (front - 0.12, front),
                (-0.5, 0.7),
                jitter(rng, (0.3, 0.29, 0.28)),
                Look.PLAIN,
            )
        )
    if rng.random() < 0.5 and height > 7:  # balconies
        for z in np.arange(3.2, height - 2.2, 2.9):
            along = np.arange(-length / 2 + 2, length / 2 - 2.5, 4.6)
            parts += [box((x, x + 2.2), (front - 1.1, front), (z, z + 1.05), METAL, Look.SLATS) for x in along]
    if rng.random() < 0.45:  # awning or canopy
        x = float(rng.uniform(-length / 2, length / 2 - 3.5))
        parts.append(box((x, x + 3.5), (front - 1.4, front), (2.6, 2.8), _wall_color(rng), Look.STRIPES))
    if rng.random() < 0.5:  # porch, bay or stairwell
        x = float(rng.uniform(-length / 2 + 1, length / 2 - 3))
        parts.append(box((x, x + 2.4), (front - 0.9, front), (-0.5, min(height, 3 + 4 * rng.random())), color, look))
    if rng.random() < 0.6:  # eaves
        parts.append(
            box(
                (-length / 2 - 0.2, length / 2 + 0.2),
                (front - 0.4, depth / 2),
                (height, height + 0.35),
                (0.3, 0.25, 0.22),
            )
        )
    return parts


def wall(rng: np.random.Generator, length: float) -> list[Part]:
    """A garden wall, board fence or railing along x."""
    style = int(rng.integers(3))
    height = 0.9 + 1.0 * float(rng.random())
    if style == 0:
        return [box((-length / 2, length / 2), (-0.12, 0.12), (-0.3, height), _wall_color(rng), Look.BRICK)]
    if style == 1:
        color = jitter(rng, (0.32, 0.24, 0.15))
        return [box((-length / 2, length / 2), (-0.04, 0.04), (-0.1, height + 0.3), color, Look.SLATS)]
    posts = [post(float(x), 0.0, (0, 1.1), 0.04, METAL) for x in np.arange(-length / 2, length / 2 + 0.1, 1.8)]
    rails = [box((-length / 2, length / 2), (-0.03, 0.03), (z, z + 0.07), METAL) for z in (0.25, 0.6, 1.02)]
    return posts + rails


def tree(rng: np.random.Generator) -> list[Part]:
    """A street tree: a leaning trunk, a few branches, a crown of several balls."""
    height, spread = 4.5 + 4.5 * float(rng.random()), 1.3 + 1.3 * float(rng.random())
    bark = jitter(rng, (0.2, 0.15, 0.11))
    crown = height - spread
    lean = rng.normal(0, 0.15, 2)
    top = (float(lean[0]), float(lean[1]), crown)
    parts = [beam((0, 0, -0.2), top, 0.1 + 0.04 * height / 4, bark, Look.BARK, 0.3)]
    leaf = _leaf_color(rng)
    for _ in range(int(rng.integers(4, 7))):
        angle, away = rng.uniform(0, 2 * np.pi), spread * 0.65 * np.sqrt(rng.random())
        x, y, z = top[0] + away * np.cos(angle), top[1] + away * np.sin(angle), crown + spread * rng.uniform(-0.15, 0.8)
        size = spread * rng.uniform(0.5, 0.8)
        half = (size, size * rng.uniform(0.85, 1.1), size * rng.uniform(0.65, 0.9))
        parts.append(ball(float(x), float(y), float(z), half, jitter(rng, leaf, 0.05), Look.LEAVES, Kind.CROWN, 0.45))
    fork = (top[0] * 0.8, top[1] * 0.8, crown * 0.8)
    return parts + [beam(fork, part.center, 0.06, bark, Look.BARK, 0.3) for part in parts[2:4]]


def bush(rng: np.random.Generator) -> list[Part]:
    """A shrub of two or three balls."""
    leaf = _leaf_color(rng)
    parts = []
    for _ in range(int(rng.integers(2, 4))):
        size = rng.uniform(0.4, 0.85)
        x, y = rng.normal(0, 0.4, 2)
        half = (float(size), float(size), float(size * 0.8))
        parts.append(
            ball(float(x), float(y), float(size * 0.55), half, jitter(rng, leaf), Look.LEAVES, Kind.CROWN, 0.45)
        )
    return parts


def hedge(rng: np.random.Generator, length: float) -> list[Part]:
    """A clipped hedge along x."""
    half = (length / 2, 0.35 + 0.15 * float(rng.random()))
    height = 0.9 + 0.8 * float(rng.random())
    return [box((-half[0], half[0]), (-half[1], half[1]), (-0.1, height), _leaf_color(rng), Look.LEAVES, 0.45)]


def lamp(rng: np.random.Generator) -> list[Part]:
    """A street lamp, its arm towards −y."""
    height = 6 + 2 * float(rng.random())
    arm = 1.2 + float(rng.random())
    return [
        post(0, 0, (-0.1, height), 0.09, METAL, taper=0.4),
        beam((0, 0, height - 0.1), (0, -arm, height + 0.15), 0.05, METAL),
        box((-0.14, 0.14), (-arm - 0.5, -arm), (height + 0.08, height + 0.2), (0.4, 0.4, 0.4)),
    ]


def sign(rng: np.random.Generator) -> list[Part]:
    """A traffic sign or street name on a pole, facing −x."""
    z, half = 2.1 + 0.4 * float(rng.random()), 0.3 + 0.1 * float(rng.random())
    color: Color = ((0.6, 0.05, 0.05), (0.06, 0.15, 0.5), (0.75, 0.6, 0.05))[int(rng.integers(3))]
    return [
        post(0, 0, (-0.1, z + half), 0.04, METAL),
        box((-0.07, -0.04), (-half, half), (z - half, z + half), color, Look.SIGN, 0.95),
    ]


def traffic_light(rng: np.random.Generator) -> list[Part]:
    """A signal head on a mast."""
    z = 2.4 + 0.5 * float(rng.random())
    return [
        post(0, 0, (-0.1, z + 0.9), 0.07, METAL),
        box((-0.3, -0.08), (-0.16, 0.16), (z, z + 0.9), (0.06, 0.07, 0.06)),
    ]


def bollard(rng: np.random.Generator) -> list[Part]:
    """A bollard or hydrant, knee-high."""
    height = 0.75 + 0.3 * float(rng.random())
    return [post(0, 0, (-0.1, height), 0.09 + 0.04 * float(rng.random()), jitter(rng, METAL, 0.1), taper=0.1)]


def cabinet(rng: np.random.Generator) -> list[Part]:
    """A switch box at the roadside."""
    width = 0.5 + 0.5 * float(rng.random())
    return [box((-width / 2, width / 2), (-0.2, 0.2), (-0.1, 1.1 + 0.3 * rng.random()), jitter(rng, (0.4, 0.42, 0.38)))]


def container(rng: np.random.Generator) -> list[Part]:
    """A site hut or shipping container: manmade, though it looks like a trailer's box."""
    color = jitter(rng, ((0.12, 0.25, 0.38), (0.42, 0.2, 0.12), (0.5, 0.5, 0.48))[int(rng.integers(3))])
    return [box((-3.0, 3.0), (-1.2, 1.2), (0.0, 2.6), color, Look.SLATS)]


def cone(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A traffic cone on its foot."""
    height = 0.7 + 0.3 * float(rng.random())
    orange = jitter(rng, (0.85, 0.27, 0.05), 0.04)
    return [
        box((-0.2, 0.2), (-0.2, 0.2), (0.0, 0.05), (0.1, 0.1, 0.1)),
        post(0, 0, (0.05, height), 0.17, orange, Look.STRIPES, 0.7, taper=0.8),
    ], (0.4, 0.4, height)


def barrier(rng: np.random.Generator, style: int) -> tuple[list[Part], Size]:
    """One element of a temporary barrier across x: concrete, plastic or boards, alike along a row.

    Args:
        rng: source of wear.
        style: 0 concrete, 1 red-white plastic, 2 boards on feet.
    """
    if style == 0:
        color = jitter(rng, (0.5, 0.49, 0.46))
        return [
            box((-0.3, 0.3), (-0.95, 0.95), (0.0, 0.3), color),
            Part(Kind.WEDGE, (0, 0, 0.58), (0.22, 0.95, 0.28), color, taper=0.2),
        ], (1.9, 0.6, 0.86)
    if style == 1:
        color = jitter(rng, (0.75, 0.16, 0.06))
        return [Part(Kind.WEDGE, (0, 0, 0.45), (0.25, 0.9, 0.45), color, Look.PLAIN, 0.5, taper=0.2)], (1.8, 0.5, 0.9)
    return [
        box((-0.25, 0.25), (-0.85, -0.75), (0.0, 0.1), METAL),
        box((-0.25, 0.25), (0.75, 0.85), (0.0, 0.1), METAL),
        box((-0.04, 0.04), (-0.85, -0.78), (0.1, 1.05), METAL),
        box((-0.04, 0.04), (0.78, 0.85), (0.1, 1.05), METAL),
        box((-0.03, 0.03), (-0.9, 0.9), (0.75, 1.05), (0.8, 0.3, 0.06), Look.STRIPES, 0.8),
        box((-0.03, 0.03), (-0.9, 0.9), (0.3, 0.55), (0.8, 0.3, 0.06), Look.STRIPES, 0.8),
    ], (1.8, 0.5, 1.05)


def bin_(rng: np.random.Generator) -> tuple[list[Part], Size]:
    """A wheeled bin: pushable, which the challenge ignores."""
    color = jitter(rng, ((0.1, 0.2, 0.1), (0.1, 0.1, 0.11), (0.1, 0.15, 0.3))[int(rng.integers(3))])
    return [box((-0.35, 0.35), (-0.3, 0.3), (0.0, 1.05), color)], (0.6, 0.7, 1.05)


def rack(rng: np.random.Generator) -> list[Part]:
    """A row of bicycle stands: its own raw category, void in the challenge."""
    count = int(rng.integers(3, 6))
    stands = []
    for i in range(count):
        x = (i - count / 2) * 0.9
        stands += [
            beam((x, -0.35, 0), (x, -0.35, 0.8), 0.03, METAL),
            beam((x, 0.35, 0), (x, 0.35, 0.8), 0.03, METAL),
            beam((x, -0.35, 0.8), (x, 0.35, 0.8), 0.03, METAL),
        ]
    return stands
