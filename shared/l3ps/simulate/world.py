"""A street scene: the ground, everything that stands or moves on it, and the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..taxonomy import NUSCENES_RAW_INDEX, NUSCENES_RAW_TO_16
from .parts import Part, turn
from .shapes import Solids
from .street import Street
from .textures import NoiseTiles

Double = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Where an object is at any time.

    Attributes:
        x, offset: place along and beside the street at time 0, metres.
        speed: along the street, m/s; negative against its x axis.
        heading: yaw relative to the street, radians.
        height: of the object's origin above the ground, metres.
    """

    x: float
    offset: float
    speed: float = 0.0
    heading: float = 0.0
    height: float = 0.0


def poses(street: Street, motions: Sequence[Motion], time: float) -> Double:
    """(n, 4, 4) object → street of moving objects at a time in seconds."""
    x, offset, speed, heading, height = np.array([astuple(m) for m in motions], dtype=np.float64).reshape(-1, 5).T
    x, y, along = street.place(x + speed * time, offset)
    _, raised = street.surface(x.astype(np.float32), y.astype(np.float32))
    matrices = np.zeros((len(x), 4, 4))
    cos, sin = np.cos(along + heading), np.sin(along + heading)
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = cos, -sin, sin, cos
    matrices[:, 0, 3], matrices[:, 1, 3], matrices[:, 2, 3] = x, y, height + street.kerb * raised
    matrices[:, 2, 2] = matrices[:, 3, 3] = 1
    return matrices


@dataclass(frozen=True)
class Actor:
    """One object of the scene; with a size it is a thing and has an instance.

    Attributes:
        category: nuScenes raw category.
        parts: its solids.
        motion: its path.
        size: width, length, height of its box, or None for stuff.
        attribute: nuScenes attribute name or "".
        instance: id unique in the scene from 1, 0 for stuff.
    """

    category: str
    parts: list[Part] = field(repr=False)
    motion: Motion
    size: tuple[float, float, float] | None = None
    attribute: str = ""
    instance: int = 0


@dataclass(frozen=True)
class Light:
    """Sun, sky and air.

    Attributes:
        direction: (3,) unit vector towards the sun, street frame.
        sun, sky: (3,) colour times strength of direct and of scattered light.
        zenith, horizon: (3,) colour of the sky.
        visibility: distance in metres at which haze hides two thirds of the contrast.
        clouds: 0 clear … 1 overcast.
    """

    direction: Double
    sun: Double
    sky: Double
    zenith: Double
    horizon: Double
    visibility: float
    clouds: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Light:
        """Daylight of a random hour and weather."""
        elevation, azimuth = np.radians(rng.uniform(18, 65)), rng.uniform(0, 2 * np.pi)
        clouds = float(rng.random())
        direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        warmth = np.array([1.0, 0.95, 0.85]) ** (1.5 - np.sin(elevation))
        clear, grey = np.array([0.32, 0.5, 0.8]), np.array([0.66, 0.69, 0.72])
        return cls(
            direction=np.array(direction),
            sun=warmth * (1.25 - 1.1 * clouds),
            sky=np.array([0.5, 0.53, 0.58]) * (0.75 + 0.6 * clouds),
            zenith=clear * (1 - clouds) + grey * clouds,
            horizon=np.array([0.78, 0.82, 0.86]) * (1 - 0.12 * clouds),
            visibility=float(rng.uniform(150, 600)),
            clouds=clouds,
        )


@dataclass(frozen=True)
class World:
    """Everything the sensors can see.

    Attributes:
        street: the ground.
        actors: the objects.
        light: how it is lit.
        tiles: the noise its surfaces are made of.
        ego: the path of the recording vehicle.
        tilt: (4, 4) street → world: a slight slope and the place on the map.
    """

    street: Street
    actors: tuple[Actor, ...]
    light: Light
    tiles: NoiseTiles
    ego: Motion
    tilt: Double

    def __post_init__(self) -> None:
        parts = [(i, part) for i, actor in enumerate(self.actors) for part in actor.parts]
        cached = {
            "_owner": np.array([i for i, _ in parts], np.int32),
            "_center": np.array([p.center for _, p in parts]),
            "_turn": np.array([turn(*p.angles) for _, p in parts]),
            "_fixed": poses(self.street, [a.motion for a in self.actors], 0.0),
            "_moving": np.flatnonzero([a.motion.speed != 0 for a in self.actors]),
            "kind": np.array([p.kind for _, p in parts], np.uint8),
            "half": np.array([p.half for _, p in parts]),
            "taper": np.array([p.taper for _, p in parts]),
            "color": np.array([p.color for _, p in parts], np.float32),
            "look": np.array([p.look for _, p in parts], np.uint8),
            "reflect": np.array([p.reflect for _, p in parts], np.float32),
            "raw": np.array([NUSCENES_RAW_INDEX.index(a.category) for a in self.actors], np.uint8),
            "semantic": np.array([NUSCENES_RAW_TO_16[a.category] for a in self.actors], np.uint8),
            "instance": np.array([a.instance for a in self.actors], np.int32),
        }
        for name, value in cached.items():
            object.__setattr__(self, name, value)

    _owner: NDArray[np.int32] = field(init=False, repr=False)
    _center: Double = field(init=False, repr=False)
    _turn: Double = field(init=False, repr=False)
    _fixed: Double = field(init=False, repr=False)
    _moving: NDArray[np.intp] = field(init=False, repr=False)
    kind: NDArray[np.uint8] = field(init=False, repr=False)
    half: Double = field(init=False, repr=False)
    taper: Double = field(init=False, repr=False)
    color: NDArray[np.float32] = field(init=False, repr=False)
    look: NDArray[np.uint8] = field(init=False, repr=False)
    reflect: NDArray[np.float32] = field(init=False, repr=False)
    raw: NDArray[np.uint8] = field(init=False, repr=False)
    semantic: NDArray[np.uint8] = field(init=False, repr=False)
    instance: NDArray[np.int32] = field(init=False, repr=False)

    def poses(self, time: float) -> Double:
        """(A, 4, 4) actor → street at a time in seconds."""
        placed = self._fixed.copy()
        placed[self._moving] = poses(self.street, [self.actors[i].motion for i in self._moving], time)
        return placed

    def solids(self, time: float) -> Solids:
        """All solids where they are at a time in seconds."""
        pose = self.poses(time)[self._owner]
        center = np.einsum("mij,mj->mi", pose[:, :3, :3], self._center) + pose[:, :3, 3]
        return Solids(self.kind, center, pose[:, :3, :3] @ self._turn, self.half, self.taper, self._owner)

    def ego_pose(self, time: float) -> Double:
        """(4, 4) ego → street."""
        return np.asarray(poses(self.street, [self.ego], time)[0])
