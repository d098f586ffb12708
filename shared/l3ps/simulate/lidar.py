"""A 32-beam spinning LiDAR.

The whole sweep is cast from the pose at the scan's time stamp: the points are what a perfectly motion-compensated
sweep would hold, as the nuScenes files do, and moving objects stand where they are at that time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..taxonomy import NUSCENES_RAW_INDEX
from .camera import GROUND_RAW
from .parts import Look, turn
from .shading import markings
from .shapes import EDGES, Kind, RayGrid, Windows, cast
from .street import meet_ground
from .surfaces import locate
from .world import World

Float = NDArray[np.float32]
Double = NDArray[np.float64]
BEAMS, STEPS = 32, 1085
LOWEST, HIGHEST = -30.67, 10.67
"""Elevations of the outer beams in degrees (Velodyne HDL-32E)."""
POSITION = (0.94, 0.0, 1.84)
"""Mounting point in the ego frame, metres."""
MIN_RANGE, MAX_RANGE = 1.5, 95.0
NOISE = 0.018
"""Standard deviation of the range, metres."""
GROUND_RAW_INDEX = np.array([0] + [NUSCENES_RAW_INDEX.index(GROUND_RAW[k]) for k in sorted(GROUND_RAW)], np.uint8)
GROUND_REFLECT = np.array([0.0, 0.13, 0.25, 0.35, 0.25], np.float32)


def lidar_to_ego() -> Double:
    """(4, 4) extrinsic: x right, y forward as in nuScenes, with the slight tilt of a real mount."""
    pose = np.eye(4)
    pose[:3, :3] = turn(np.radians(-89.9), np.radians(0.2), np.radians(0.4))
    pose[:3, 3] = POSITION
    return pose


@dataclass(frozen=True)
class SpinningGrid(RayGrid):
    """All beams of one revolution, rows by elevation from the lowest, columns by azimuth; rays have length one."""

    pose: Double
    steps: int = STEPS

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return BEAMS, self.steps

    @property
    def origin(self) -> Double:
        """(3,) optical centre, street frame."""
        return self.pose[:3, 3]

    @property
    def rotation(self) -> Double:
        """(3, 3) sensor → street."""
        return self.pose[:3, :3]

    @cached_property
    def _elevation(self) -> Double:
        return np.radians(np.linspace(LOWEST, HIGHEST, BEAMS))

    def directions(self, matrix: Double, rows: slice, columns: slice) -> Float:
        """See :meth:`~.shapes.RayGrid.directions`."""
        m = matrix.astype(np.float32)
        azimuth = (np.arange(columns.start, columns.stop, dtype=np.float32) + 0.5) * np.float32(2 * np.pi / self.steps)
        elevation = self._elevation[rows].astype(np.float32)
        around = m[:, 0, None] * np.cos(azimuth) + m[:, 1, None] * np.sin(azimuth)
        return np.asarray(
            around[:, None, :] * np.cos(elevation)[:, None] + (m[:, 2, None] * np.sin(elevation))[:, :, None]
        )

    def windows(self, corners: Double) -> Windows:
        """See :meth:`~.shapes.RayGrid.windows`."""
        middle = corners.mean(axis=1)
        center = np.arctan2(middle[:, 1], middle[:, 0])
        azimuth = np.arctan2(corners[..., 1], corners[..., 0]) - center[:, None]
        azimuth = (azimuth + np.pi) % (2 * np.pi) - np.pi
        low, high = center + azimuth.min(axis=1), center + azimuth.max(axis=1)
        near, far = _horizontal_range(corners)
        around = (high - low > np.pi) | (near < 0.05)
        top, bottom = corners[..., 2].max(axis=1), corners[..., 2].min(axis=1)
        up = np.arctan2(top, np.where(top > 0, near, far))
        down = np.arctan2(bottom, np.where(bottom < 0, near, far))
        step, beam = 2 * np.pi / self.steps, self._elevation
        first, last = np.searchsorted(beam, down - 1e-6), np.searchsorted(beam, up + 1e-6, side="right")
        start = np.where(around, 0, np.floor(low / step - 0.5)).astype(np.intp)
        stop = np.where(around, self.steps, np.ceil(high / step + 0.5)).astype(np.intp)
        shift = np.where(start < 0, self.steps, 0)
        start, stop = start + shift, stop + shift
        over = stop > self.steps
        index = np.arange(len(corners))
        solid = np.concatenate([index, index[over]])
        begin = np.concatenate([start, np.zeros(int(over.sum()), np.intp)])
        end = np.concatenate([np.minimum(stop, self.steps), stop[over] - self.steps])
        keep = (last > first)[solid] & (end > begin) & (near < MAX_RANGE)[solid]
        rows = np.stack([first, last], axis=1)[solid]
        return Windows(solid[keep], rows[keep], np.stack([begin, end], axis=1)[keep], near[solid][keep])


def _horizontal_range(corners: Double) -> tuple[Double, Double]:
    """Least and greatest distance from the vertical through the origin to boxes given by (M, 8, 3) corners."""
    a, b = corners[:, EDGES[:, 0], :2], corners[:, EDGES[:, 1], :2]
    along = b - a
    share = np.clip(-(a * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-12), 0, 1)
    near = np.linalg.norm(a + share[..., None] * along, axis=-1).min(axis=1)
    return near, np.linalg.norm(corners[..., :2], axis=-1).max(axis=1)


@dataclass(frozen=True)
class Sweep:
    """One revolution's returns, in firing order (column by column).

    Attributes:
        points: (N, 5) float32 x, y, z in metres in the lidar frame, intensity 0..255, beam.
        raw: (N,) uint8 nuScenes raw category index.
        instance: (N,) int32 instance id of the scene, 0 for none.
        ranges: (32, steps) float32 range of what each ray met, noise-free, infinite where nothing was met.
        actors: (32, steps) int32 index of the actor met, -1 for ground or nothing.
    """

    points: Float
    raw: NDArray[np.uint8]
    instance: NDArray[np.int32]
    ranges: Float
    actors: NDArray[np.int32]


def sweep(world: World, time: float, rng: np.random.Generator, steps: int = STEPS) -> Sweep:
    """Scan the world.

    Args:
        world: what there is.
        time: of the scan, seconds since the scene began.
        rng: source of range noise and drop-out.
        steps: azimuth steps a revolution.
    """
    grid = SpinningGrid(world.ego_pose(time) @ lidar_to_ego(), steps)
    solids = world.solids(time)
    hits = cast(solids, grid, world.tiles.medium)
    rays = grid.directions(grid.rotation, slice(0, BEAMS), slice(0, steps)).reshape(3, -1)
    depth, solid = hits.depth.ravel(), hits.solid.ravel()
    ground = meet_ground(world.street, grid.origin, rays)
    on_ground = ground.depth < depth
    depth = np.where(on_ground, ground.depth, depth)
    solid = np.where(on_ground, -1, solid)
    actor = np.where(solid >= 0, solids.owner[solid], -1).astype(np.int32)

    met = np.flatnonzero(depth < MAX_RANGE)
    points = (grid.origin.astype(np.float32)[:, None] + depth[met] * rays[:, met]).T
    reflect, facing = np.empty(len(met), np.float32), np.empty(len(met), np.float32)
    bare = solid[met] < 0
    flat = met[bare]
    paint = markings(world, ground.kind[flat], points[bare, 0], points[bare, 1])
    reflect[bare] = np.where(paint, np.float32(0.7), GROUND_REFLECT[ground.kind[flat]])
    facing[bare] = np.where(ground.face[flat], np.float32(0.8), -rays[2, flat])
    hit = met[~bare]
    spots = locate(solids, solid[hit], points[~bare])
    reflect[~bare] = world.reflect[solid[hit]]
    facing[~bare] = np.abs((spots.normal * rays[:, hit].T).sum(axis=1))

    signal = reflect * (0.15 + 0.85 * facing)
    reach = 130 * np.sqrt(signal)  # where half of the pulses come back too weak
    chance = 0.985 / (1 + (depth[met] / reach) ** 8)
    noise = rng.standard_normal(len(met), dtype=np.float32) * np.float32(NOISE)
    leafy = np.isin(world.look[solid[met]], (Look.LEAVES,)) & ~bare
    inside = rng.exponential(0.18, len(met)).astype(np.float32)
    crown = leafy & (solids.kind[solid[met]] == Kind.CROWN)
    noise += np.where(crown, np.minimum(inside, 0.8), np.where(leafy, 0.25 * inside, 0))
    grass = bare & (ground.kind[met] == 3)
    noise -= np.where(grass, np.minimum(0.3 * inside, 0.12), 0)  # blades stand above the ground
    measured = depth[met] + noise
    kept = (rng.random(len(met)) < chance) & (measured > MIN_RANGE)

    local = grid.directions(np.eye(3), slice(0, BEAMS), slice(0, steps)).reshape(3, -1)[:, met]
    beam, column = np.divmod(met, steps)
    intensity = np.clip(255 * signal * rng.uniform(0.75, 1.15, len(met)), 0, 255).astype(np.float32)
    table = np.column_stack([(local * measured).T, intensity, beam.astype(np.float32)]).astype(np.float32)
    raw = np.where(bare, GROUND_RAW_INDEX[ground.kind[met]], world.raw[actor[met]])
    instance = np.where(bare, 0, world.instance[actor[met]])
    order = np.flatnonzero(kept)[np.lexsort((beam[kept], column[kept]))]
    ranges = np.where(depth < MAX_RANGE, depth, np.float32(np.inf)).reshape(grid.shape)
    return Sweep(
        table[order], raw[order].astype(np.uint8), instance[order].astype(np.int32), ranges.astype(np.float32),
        actor.reshape(grid.shape),
    )  # fmt: skip
