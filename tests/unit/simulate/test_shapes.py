"""Rays meet solids where geometry says, and windows never hide a hit."""

import numpy as np
import pytest

from l3ps.simulate.camera import RIG, PinholeGrid
from l3ps.simulate.lidar import SpinningGrid, lidar_to_ego
from l3ps.simulate.shapes import Kind, Solids, Windows, cast

LEAVES = np.full((512, 512), 2.5, np.float32)  # crowns without holes


def solid(kind, center, half, taper=0.0, rotation=None):
    rotation = np.eye(3) if rotation is None else rotation
    return Solids(
        np.array([kind], np.uint8), np.array([center], float), rotation[None], np.array([half], float),
        np.array([taper]), np.zeros(1, np.int32),
    )  # fmt: skip


def straight_ahead(solids, height=0.0):
    """Depth along the optical axis of a camera at the origin that looks along x."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[2, 3] = height
    grid = PinholeGrid(np.array([[50, 0, 10.5], [0, 50, 10.5], [0, 0, 1.0]]), pose, 21, 21)
    return cast(solids, grid, LEAVES).depth[10, 10]


@pytest.mark.parametrize(
    ("kind", "half", "taper", "height", "expected"),
    [
        (Kind.BOX, (2, 1, 1), 0.0, 0.0, 8.0),
        (Kind.WEDGE, (2, 1, 1), 1.0, 0.0, 8.5),
        (Kind.WEDGE, (2, 1, 1), 1.0, -0.5, 8.25),
        (Kind.FRUSTUM, (2, 2, 1), 0.0, 0.0, 8.0),
        (Kind.FRUSTUM, (2, 2, 1), 1.0, 0.0, 9.0),
        (Kind.ELLIPSOID, (2, 3, 1), 0.0, 0.0, 8.0),
        (Kind.CROWN, (2, 3, 1), 0.0, 0.0, 8.0),
        (Kind.BOX, (2, 1, 1), 0.0, 1.5, np.inf),
        (Kind.FRUSTUM, (2, 2, 1), 0.0, 1.5, np.inf),
        (Kind.ELLIPSOID, (2, 3, 1), 0.0, 1.5, np.inf),
    ],
)
def test_depth_of_a_solid_ten_metres_ahead(kind, half, taper, height, expected):
    assert straight_ahead(solid(kind, (10, 0, 0), half, taper), height) == pytest.approx(expected, rel=1e-5)


def test_the_nearer_of_two_solids_wins():
    near, far = solid(Kind.BOX, (10, 0, 0), (1, 1, 1)), solid(Kind.BOX, (20, 0, 0), (5, 5, 5))
    both = Solids(*(np.concatenate(pair) for pair in zip(vars_of(far), vars_of(near), strict=True)))
    assert straight_ahead(both) == pytest.approx(9)


def vars_of(solids):
    return [getattr(solids, name) for name in ("kind", "center", "rotation", "half", "taper", "owner")]


def test_a_frustum_seen_from_above_shows_its_lid(world):
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])  # looks down
    pose[2, 3] = 10
    grid = PinholeGrid(np.array([[50, 0, 10.5], [0, 50, 10.5], [0, 0, 1.0]]), pose, 21, 21)
    assert cast(solid(Kind.FRUSTUM, (0, 0, 0), (1, 1, 2)), grid, LEAVES).depth[10, 10] == pytest.approx(8)


class Unwindowed:
    """The same rays, every solid tried on all of them."""

    def __init__(self, grid):
        self.grid = grid
        self.shape, self.origin, self.rotation, self.directions = (
            grid.shape, grid.origin, grid.rotation, grid.directions,
        )  # fmt: skip

    def windows(self, corners):
        n, (rows, columns) = len(corners), self.shape
        return Windows(np.arange(n), np.tile([0, rows], (n, 1)), np.tile([0, columns], (n, 1)), np.zeros(n))


@pytest.mark.parametrize("sensor", ["camera", "lidar"])
def test_windows_hide_no_hit(world, sensor):
    """A window that is too small would cut objects off at straight lines."""
    ego = world.ego_pose(2.0)
    if sensor == "camera":
        grid = PinholeGrid(RIG[1].intrinsic(64, 36), ego @ RIG[1].camera_to_ego, 64, 36)
    else:
        grid = SpinningGrid(ego @ lidar_to_ego(), 90)
    solids = world.solids(2.0)
    near = np.linalg.norm(solids.center[:, :2] - ego[:2, 3], axis=1) < 45
    near &= solids.half.max(axis=1) > 0.3
    solids = Solids(*(part[near] for part in vars_of(solids)))
    got, expected = cast(solids, grid, LEAVES).depth, cast(solids, Unwindowed(grid), LEAVES).depth
    # A camera forgoes what is smaller than a pixel: a stray pixel may differ, a cut edge would be hundreds.
    assert np.mean(~np.isclose(got, expected, rtol=1e-4)) < (0.005 if sensor == "camera" else 1e-9)
