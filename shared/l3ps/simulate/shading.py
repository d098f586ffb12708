"""The colour of surfaces: procedural paint per look, shadows on the ground, sky, haze."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .parts import Look
from .shapes import Kind, Solids
from .street import X_MAX, X_MIN, Surface
from .surfaces import Spots
from .textures import cell_hash, sample
from .world import Light, World

Float = NDArray[np.float32]
SHADOW_STEP = 0.125
"""Metres a texel of the shadow map."""
SHADOW_REACH = 45.0
"""The shadow map covers offsets up to this from the street's axis, metres."""
GLASS = np.array([0.06, 0.075, 0.085], dtype=np.float32)
SHADES: dict[int, tuple[float, float, float]] = {
    Surface.ROAD: (0.165, 0.165, 0.17),
    Surface.SIDEWALK: (0.36, 0.335, 0.305),
    Surface.TERRAIN: (0.17, 0.2, 0.09),
    Surface.OTHER: (0.3, 0.29, 0.27),
}


def _fade(distance: Float, metres: float) -> Float:
    """How much of a texture of a certain grain is left at a distance; beyond, it would only flicker."""
    return np.asarray(1 / (1 + (distance / np.float32(metres)) ** 2), dtype=np.float32)


def shadow_map(
    world: World, solids: Solids, which: NDArray[np.bool_], base: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Shadows of solids on the ground seen from above.

    Args:
        world: gives the sun.
        solids: the solids at the time of the image.
        which: (M,) bool, those to draw.
        base: a map to draw over (it is copied).

    Returns:
        (rows along y, columns along x) uint8, 255 where the sun does not reach.
    """
    shape = (int(2 * SHADOW_REACH / SHADOW_STEP), int((X_MAX - X_MIN) / SHADOW_STEP))
    image = np.zeros(shape, np.uint8) if base is None else base.copy()
    sun = world.light.direction
    corners = solids.corners()[which]
    middle = solids.center[which][:, None, :2]
    corners[..., 2] = np.maximum(corners[..., 2], 0)
    ground = corners[..., :2] - corners[..., 2:] * sun[:2] / sun[2]
    rounder = (solids.kind[which] >= Kind.ELLIPSOID)[:, None, None]
    ground = np.where(rounder, ground.mean(axis=1, keepdims=True) * 0.25 + ground * 0.75, ground)
    near = (np.abs(middle[:, 0, 1]) < SHADOW_REACH + 10) & (middle[:, 0, 0] > X_MIN) & (middle[:, 0, 0] < X_MAX)
    pixels = ((ground - [X_MIN, -SHADOW_REACH]) / SHADOW_STEP).astype(np.int32)
    for polygon in pixels[near]:
        cv2.fillConvexPoly(image, cv2.convexHull(polygon), 255)
    return image


def paint_ground(
    world: World, kind: NDArray[np.uint8], face: NDArray[np.bool_], x: Float, y: Float, away: Float
) -> Float:
    """(n, 3) albedo of ground at places (x, y), `away` metres from the eye; `face` marks upright kerb stones."""
    tiles, street = world.tiles, world.street
    fine = sample(tiles.fine, x, y, 40) * _fade(away, 12)
    blotch = sample(tiles.medium, x, y, 9) * _fade(away, 45)
    stain = sample(tiles.coarse, x, y, 4)
    table = np.zeros((len(Surface), 3), np.float32)
    for surface, shade in SHADES.items():
        table[surface] = shade
    albedo = table[kind]
    tint = world.light.clouds  # any number of this world will do to vary its materials
    relative = 1 + 0.13 * fine + 0.1 * blotch + 0.12 * stain
    road, walk = kind == Surface.ROAD, kind == Surface.SIDEWALK
    grass, other = kind == Surface.TERRAIN, kind == Surface.OTHER
    patch = sample(tiles.coarse, x + 77, y, 1.5) > 1.1
    relative[road & patch] *= 0.8
    slab = 0.6 + 0.5 * tint
    joint = (np.abs(x / slab - np.round(x / slab)) < 0.03) | (np.abs(y / slab - np.round(y / slab)) < 0.03)
    relative[walk & joint] *= 1 - 0.45 * _fade(away, 18)[walk & joint]
    albedo[walk] *= 0.85 + 0.45 * ((tint * 7) % 1)
    cobble = cell_hash((x * 6).astype(np.int32), (y * 6).astype(np.int32), 3.0)
    relative[other] *= 1 + (0.5 * (cobble[other] - 0.5)) * _fade(away, 15)[other]
    dry = np.clip(0.5 + 0.45 * stain + 0.3 * blotch + (tint - 0.5), 0, 1)[grass, None]
    albedo[grass] = albedo[grass] * (1 - dry) + np.array([0.27, 0.22, 0.15], np.float32) * dry
    relative[grass] += 0.25 * fine[grass] + 0.2 * blotch[grass]
    albedo *= np.maximum(relative, 0.2)[:, None]
    marked = markings(world, kind, x, y)
    worn = np.clip(0.75 + 0.3 * blotch + 0.2 * fine, 0, 1)[marked, None]
    albedo[marked] = albedo[marked] * (1 - worn) + 0.62 * worn
    albedo[face] = np.float32(0.36 if street.kerb > 0.135 else 0.3) * (1 + 0.15 * fine[face, None])
    return albedo


def markings(world: World, kind: NDArray[np.uint8], x: Float, y: Float) -> NDArray[np.bool_]:
    """(n,) bool, where the road carries white paint: middle line, parking bays, crossings."""
    street = world.street
    offset = street.offset(x, y)
    side = np.abs(offset)
    dash = np.mod(x, 9) < 3.5
    middle = (side < 0.07) & dash
    bay = (np.abs(side - (street.half_width - 2.35)) < 0.06) & (np.mod(x, 1.6) < 0.8)
    across = np.abs(x - np.float32(street.cross_x)) - np.float32(street.cross_half)
    zebra = (across > 1.0) & (across < 4.0) & (np.mod(offset, 1.0) < 0.5) & (side < street.half_width - 0.3)
    stop = (across > 4.6) & (across < 5.0) & (side < street.half_width - 2.4)
    clear = across > 0
    line = clear & ((middle | bay) & (across > 5) | zebra | stop)
    return np.asarray((kind == Surface.ROAD) & (side < street.half_width) & line)


def paint_solids(world: World, solid: NDArray[np.int32], spots: Spots, away: Float) -> Float:
    """(n, 3) albedo of places on solids, `away` metres from the eye."""
    tiles = world.tiles
    look = world.look[solid]
    albedo = world.color[solid]
    half = world.half.astype(np.float32)[solid]
    u, v = spots.u + (solid % 97).astype(np.float32) * 3.1, spots.v
    fine = sample(tiles.fine, u, v, 45) * _fade(away, 9)
    blotch = sample(tiles.medium, u, v, 14) * _fade(away, 40)
    stain = sample(tiles.coarse, u, v, 6)
    relative = 1 + 0.05 * fine + 0.05 * blotch + 0.06 * stain
    upright = ~spots.level

    def where(*looks: Look) -> NDArray[np.bool_]:
        return np.isin(look, looks)

    wall = where(Look.FACADE, Look.BRICK)
    relative[wall] += (0.07 * fine + 0.1 * blotch + 0.1 * stain)[wall]
    brick = where(Look.BRICK) & upright
    course = np.floor(v / 0.075)
    gap = (np.mod(v, 0.075) < 0.012) | (np.mod(u + 0.11 * np.mod(course, 2), 0.22) < 0.012)
    relative[brick & gap] *= 1 - 0.3 * _fade(away, 9)[brick & gap]
    _windows(world, albedo, solid, spots, half, wall & upright)

    leaves = where(Look.LEAVES)
    if leaves.any():
        p = spots.local[leaves]
        tuft = sample(tiles.medium, p[:, 0] * 0.8 + p[:, 2] * 0.6, p[:, 1] * 0.8 - p[:, 2] * 0.5, 26)
        depth = np.clip(0.85 + 0.38 * tuft + 0.4 * fine[leaves] + 0.12 * p[:, 2] / half[leaves, 2], 0.15, 2.2)
        relative[leaves] = depth
    bark = where(Look.BARK)
    relative[bark] += (0.25 * sample(tiles.medium, u * 4, v, 15) * _fade(away, 25))[bark]
    cloth = where(Look.CLOTH)
    relative[cloth] += (0.16 * blotch + 0.1 * fine)[cloth]
    stripes = where(Look.STRIPES)
    band = np.where(world.kind[solid] == Kind.FRUSTUM, np.mod(v, 0.36) < 0.14, np.mod(u + v, 0.5) < 0.25)
    albedo[stripes & band] = 0.75
    slats = where(Look.SLATS) & upright
    relative[slats & (np.mod(u, 0.22) < 0.045)] *= 0.62
    sign = where(Look.SIGN)
    inner = (np.abs(spots.local[:, 1]) < half[:, 1] * 0.7) & (np.abs(spots.local[:, 2]) < half[:, 2] * 0.7)
    albedo[sign & inner] = 0.7
    lacquer = where(Look.PAINT, Look.CABIN, Look.COACH)
    relative[lacquer] = 1 + 0.03 * stain[lacquer] - 0.25 * np.exp(-spots.v[lacquer] * 5)
    cabin = where(Look.CABIN) & upright
    height = spots.v / (2 * half[:, 2])
    pillar = np.where(
        spots.x_face, np.abs(spots.local[:, 1]) > half[:, 1] * 0.9, np.mod(spots.local[:, 0] + 10, 1.15) < 0.09
    )
    pane = cabin & (height > 0.12) & (height < 0.88) & ~pillar
    coach = where(Look.COACH) & upright
    pane |= coach & (spots.v > 0.15) & (spots.v < 1.25) & (np.mod(u, 1.5) > 0.14)
    albedo[pane] = GLASS
    relative[pane] = 1
    return np.asarray(albedo * np.maximum(relative, 0.1)[:, None])


def _windows(
    world: World, albedo: Float, solid: NDArray[np.int32], spots: Spots, half: Float, wall: NDArray[np.bool_]
) -> None:
    """Cut rows of windows and a ground floor into the façades, in place."""
    at = np.flatnonzero(wall & (half[:, 2] > 1.5))
    if not len(at):
        return
    salt = (solid[at] % 53).astype(np.float32)
    bay, storey = 1.9 + np.mod(salt, 7) * 0.22, 2.7 + np.mod(salt, 5) * 0.12
    u, v = spots.u[at] + 50, spots.v[at] - 0.5
    column, row = np.floor(u / bay), np.floor(v / storey)
    across, up = u / bay - column, v / storey - row
    width = 0.18 + 0.04 * np.mod(salt, 4)
    opening = (np.abs(across - 0.5) < width) & (up > 0.32) & (up < 0.8)
    shop = (row < 1) & (np.mod(salt, 3) < 1)
    opening = np.where(shop, (np.abs(across - 0.5) < 0.44) & (up > 0.12) & (up < 0.85), opening)
    frame = opening & (np.abs(across - 0.5) > width - 0.03) & ~shop
    light = cell_hash(column.astype(np.int32), row.astype(np.int32), salt)
    pane = at[opening]
    albedo[pane] = GLASS * (0.6 + 2.2 * light[opening, None])
    albedo[at[frame]] = 0.55


def lit(light: Light, albedo: Float, normal: Float, sunny: Float) -> Float:
    """(n, 3) light sent to the eye: Lambert's law under sun and sky; `sunny` is 0 in the shade."""
    facing = np.maximum(normal @ light.direction.astype(np.float32), 0) * sunny
    open_sky = 0.62 + 0.38 * normal[:, 2]
    strength = facing[:, None] * light.sun.astype(np.float32) + open_sky[:, None] * light.sky.astype(np.float32)
    return albedo * strength


def sky(world: World, direction: Float) -> Float:
    """(n, 3) colour of the sky in unit directions (n, 3)."""
    light = world.light
    up = np.clip(direction[:, 2], 0, 1)[:, None]
    color = light.horizon + (light.zenith - light.horizon) * np.sqrt(up)
    ceiling = np.float32(1) / (np.maximum(direction[:, 2], 0) + np.float32(0.12))
    cloud = sample(world.tiles.coarse, direction[:, 0] * ceiling, direction[:, 1] * ceiling, 50)
    color = color + (0.1 * np.clip(cloud, -0.5, 2) * (0.3 + light.clouds))[:, None]
    glow = np.clip(direction @ light.direction.astype(np.float32), 0, 1) ** 40
    return np.asarray(color + 0.5 * glow[:, None] * (1 - light.clouds), dtype=np.float32)


def hazed(light: Light, color: Float, distance: Float) -> Float:
    """Mix in the air's own light with distance."""
    left = np.exp(-distance / np.float32(light.visibility))[:, None]
    return np.asarray(color * left + light.horizon.astype(np.float32) * (1 - left))
