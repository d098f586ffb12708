"""Six cameras around the roof and the renderer behind them.

Each camera sits up to a metre from the LiDAR and fires when the sweep passes the middle of its view, with its own
ego pose, as on the nuScenes car: labels projected from points to pixels meet parallax and motion at every edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from . import shading
from .parts import turn
from .shapes import EDGES, RayGrid, Windows, cast
from .street import X_MIN, meet_ground
from .surfaces import locate
from .world import World

Float = NDArray[np.float32]
Double = NDArray[np.float64]
SKY = 17
"""Class of sky in pixel truth; points never see it."""
NEAR = 0.3
"""Depth in metres in front of which nothing is drawn."""
GROUND_RAW = {1: "flat.driveable_surface", 2: "flat.sidewalk", 3: "flat.terrain", 4: "flat.other"}
"""Raw category of each :class:`~.street.Surface`."""
GROUND_SEMANTIC = np.array([0, 11, 13, 14, 12], dtype=np.uint8)
"""Challenge class of each :class:`~.street.Surface`."""
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (right, down, forward) in a frame that looks along x."""


@dataclass(frozen=True)
class Mount:
    """One camera of the rig.

    Attributes:
        channel: nuScenes channel name.
        position: in the ego frame, metres.
        yaw, pitch: viewing direction in degrees, left and down positive.
        focal: focal length in image widths.
        delay: exposure relative to the scan's time stamp, seconds.
    """

    channel: str
    position: tuple[float, float, float]
    yaw: float
    pitch: float
    focal: float
    delay: float

    @property
    def camera_to_ego(self) -> Double:
        """(4, 4) extrinsic."""
        pose = np.eye(4)
        pose[:3, :3] = turn(np.radians(self.yaw), np.radians(self.pitch)) @ OPTICAL
        pose[:3, 3] = self.position
        return pose

    def intrinsic(self, width: int, height: int) -> Double:
        """(3, 3) pinhole matrix; a pixel's index is the floor of its image coordinate."""
        f = self.focal * width
        return np.array([[f, 0, width * 0.504], [0, f, height * 0.531], [0, 0, 1.0]])


RIG = (
    Mount("CAM_FRONT", (1.7, 0.0, 1.51), 0.0, 0.3, 0.791, -0.0355),
    Mount("CAM_FRONT_RIGHT", (1.55, -0.49, 1.5), -56.0, 0.4, 0.788, -0.0276),
    Mount("CAM_BACK_RIGHT", (1.01, -0.48, 1.56), -110.0, 0.5, 0.787, -0.0201),
    Mount("CAM_BACK", (0.03, 0.0, 1.58), 180.0, 0.6, 0.506, -0.0104),
    Mount("CAM_BACK_LEFT", (1.04, 0.48, 1.59), 109.0, 0.5, 0.785, -0.0005),
    Mount("CAM_FRONT_LEFT", (1.52, 0.49, 1.51), 55.0, 0.2, 0.795, -0.0431),
)
"""A ring like that of the nuScenes car, BACK with its wider view."""


@dataclass(frozen=True)
class PinholeGrid(RayGrid):
    """The rays through all pixel centres; depth along a ray is depth along the optical axis.

    Attributes:
        intrinsic: (3, 3), pixels.
        pose: (4, 4) camera → street.
        width, height: pixels.
    """

    intrinsic: Double
    pose: Double
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    @property
    def origin(self) -> Double:
        """(3,) optical centre, street frame."""
        return self.pose[:3, 3]

    @property
    def rotation(self) -> Double:
        """(3, 3) sensor → street."""
        return self.pose[:3, :3]

    @cached_property
    def _unproject(self) -> Double:
        return np.asarray(np.linalg.inv(self.intrinsic), dtype=np.float64)

    def directions(self, matrix: Double, rows: slice, columns: slice) -> Float:
        """See :meth:`~.shapes.RayGrid.directions`."""
        m = (matrix @ self._unproject).astype(np.float32)
        u = np.arange(columns.start, columns.stop, dtype=np.float32) + np.float32(0.5)
        v = np.arange(rows.start, rows.stop, dtype=np.float32) + np.float32(0.5)
        return m[:, 0, None, None] * u + (m[:, 1, None] * v + m[:, 2, None])[:, :, None]

    def windows(self, corners: Double) -> Windows:
        """See :meth:`~.shapes.RayGrid.windows`."""
        a, b = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip((NEAR - a[..., 2]) / (b[..., 2] - a[..., 2]), 0, 1)
        share = np.nan_to_num(share)
        crossing = a + share[..., None] * (b - a)  # edges that pass the near plane are cut there
        points = np.concatenate([corners, crossing], axis=1)
        seen = points[..., 2] >= NEAR - 1e-9
        scale = np.where(seen, points[..., 2], 1.0)
        pixels = (points @ self.intrinsic.T)[..., :2] / scale[..., None]
        low = np.where(seen[..., None], pixels, np.inf).min(axis=1)
        high = np.where(seen[..., None], pixels, -np.inf).max(axis=1)
        limit = np.array([self.width, self.height])
        start = np.floor(np.clip(low, 0, limit)).astype(np.intp)
        stop = np.ceil(np.clip(high, 0, limit)).astype(np.intp)
        worth = ((high - low).max(axis=1) > 0.7) & (stop > start).all(axis=1)  # smaller things vanish between pixels
        kept = np.flatnonzero(worth)
        near = np.maximum(corners[kept, :, 2].min(axis=1), NEAR)
        rows, columns = (np.stack([start[kept, i], stop[kept, i]], axis=1) for i in (1, 0))
        return Windows(kept, rows, columns, near)


@dataclass(frozen=True)
class Picture:
    """One exposure with its truth.

    Attributes:
        rgb: (H, W, 3) uint8.
        semantic: (H, W) uint8 challenge class, :data:`SKY` for sky.
        instance: (H, W) uint16 instance id of the scene, 0 for none.
        depth: (H, W) float32 metres along the optical axis, infinite in the sky.
    """

    rgb: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    depth: Float


class Renderer:
    """Draws a world; keeps what does not change between pictures (shadows of what stands still)."""

    def __init__(self, world: World) -> None:
        self.world = world
        solids = world.solids(0.0)
        moving = np.array([actor.motion.speed != 0 for actor in world.actors])
        self._moving = moving[solids.owner]
        self._shadows = shading.shadow_map(world, solids, ~self._moving)

    def picture(self, mount: Mount, time: float, size: tuple[int, int], rng: np.random.Generator) -> Picture:
        """One exposure.

        Args:
            mount: which camera.
            time: of the exposure, seconds since the scene began.
            size: (width, height), pixels.
            rng: source of sensor noise and exposure error.
        """
        world, (width, height) = self.world, size
        pose = world.ego_pose(time) @ mount.camera_to_ego
        grid = PinholeGrid(mount.intrinsic(width, height), pose, width, height)
        solids = world.solids(time)
        hits = cast(solids, grid, world.tiles.medium)
        rays = grid.directions(grid.rotation, slice(0, height), slice(0, width)).reshape(3, -1)
        depth, solid = hits.depth.ravel(), hits.solid.ravel()
        ground = meet_ground(world.street, grid.origin, rays)
        on_ground = ground.depth < depth
        depth = np.where(on_ground, ground.depth, depth)
        seen = np.isfinite(depth) & (depth < 3000)
        on_ground &= seen
        on_solid = seen & ~on_ground & (solid >= 0)
        length = np.sqrt((rays * rays).sum(axis=0))

        color = np.empty((len(depth), 3), np.float32)
        color[~seen] = shading.sky(world, (rays[:, ~seen] / length[~seen]).T)
        start = grid.origin.astype(np.float32)
        shadows = shading.shadow_map(world, solids, self._moving, self._shadows)

        at = np.flatnonzero(on_ground)
        points = start[:, None] + depth[at] * rays[:, at]
        away = depth[at] * length[at]
        albedo = shading.paint_ground(world, ground.kind[at], ground.face[at], points[0], points[1], away)
        upward = np.zeros((len(at), 3), np.float32)
        upward[:, 2] = 1
        upward[ground.face[at]] = (0, -np.sign(start[1]) * 0.8, 0.6)
        color[at] = shading.hazed(world.light, shading.lit(world.light, albedo, upward, _sunny(shadows, points)), away)

        at = np.flatnonzero(on_solid)
        points = start[:, None] + depth[at] * rays[:, at]
        away = depth[at] * length[at]
        spots = locate(solids, solid[at], points.T)
        albedo = shading.paint_solids(world, solid[at], spots, away)
        color[at] = shading.hazed(
            world.light, shading.lit(world.light, albedo, spots.normal, np.ones(len(at), np.float32)), away
        )

        semantic = np.full(len(depth), SKY, np.uint8)
        instance = np.zeros(len(depth), np.uint16)
        owner = solids.owner[solid[on_solid]]
        semantic[on_solid], instance[on_solid] = world.semantic[owner], world.instance[owner]
        semantic[on_ground] = GROUND_SEMANTIC[ground.kind[on_ground]]
        depth[~seen] = np.inf
        return Picture(
            _develop(color.reshape(height, width, 3), rng), semantic.reshape(height, width),
            instance.reshape(height, width), depth.reshape(height, width),
        )  # fmt: skip


def _sunny(shadows: NDArray[np.uint8], points: Float) -> Float:
    """(n,) share of direct sun on ground points (3, n)."""
    column = np.clip((points[0] - X_MIN) / shading.SHADOW_STEP, 0, shadows.shape[1] - 1).astype(np.intp)
    row = np.clip((points[1] + shading.SHADOW_REACH) / shading.SHADOW_STEP, 0, shadows.shape[0] - 1).astype(np.intp)
    return np.asarray(1 - shadows[row, column].astype(np.float32) * np.float32(0.9 / 255))


def _develop(light: Float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """From light to pixels: exposure, lens blur, vignette, sensor noise, gamma."""
    height, width = light.shape[:2]
    exposure = 0.5 / max(float(np.median(light)), 0.08) ** 0.6 * float(rng.uniform(0.62, 0.95))
    balance = rng.normal(1, 0.025, 3).astype(np.float32)
    blurred = cv2.GaussianBlur(light * (balance * np.float32(exposure)), (0, 0), 0.55)
    x, y = np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    vignette = 1 - np.float32(0.16) * (x[None, :] ** 2 + y[:, None] ** 2)
    image: Float = np.sqrt(np.clip(np.asarray(blurred, np.float32) * vignette[..., None], 0, 1.15))
    image = image + rng.standard_normal(image.shape, dtype=np.float32) * np.float32(rng.uniform(0.008, 0.02))
    return np.clip(image * 255, 0, 255).astype(np.uint8)
