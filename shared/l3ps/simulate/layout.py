"""The town planner: draws a street and fills it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..taxonomy import NUSCENES_RAW_TO_16
from . import furniture, vehicles
from .parts import Look, Part
from .people import pedestrian
from .street import LEFT, RIGHT, X_MAX, X_MIN, Street, Surface, bins, span
from .world import Actor, Motion

Size = tuple[float, float, float]
SIDES = (RIGHT, LEFT)
LANE = 2.05
"""Middle of a driving lane from the centre line, metres."""
WALKING, CYCLING = 1.35, 4.0
"""Speeds in m/s, one for all, so that nobody walks through anybody."""


def draw_street(rng: np.random.Generator) -> Street:
    """A street without lots; :class:`Planner` writes those."""
    verge = tuple(float(rng.uniform(1.4, 2.4)) if rng.random() < 0.6 else 0.0 for _ in SIDES)
    walk = tuple(float(rng.uniform(3.0, 3.8)) + (1.1 if v == 0 else 0.0) for v in verge)
    return Street(
        amplitude=float(rng.uniform(1.0, 5.0)), wavenumber=2 * np.pi / float(rng.uniform(180, 320)),
        phase=float(rng.uniform(0, 2 * np.pi)), half_width=float(rng.uniform(6.9, 7.6)),
        kerb=float(rng.uniform(0.12, 0.15)), verge=(verge[0], verge[1]), walk=(walk[0], walk[1]),
        cross_x=float(rng.uniform(-25, 60)), cross_half=float(rng.uniform(4.2, 6.0)),
        lots=np.full((2, bins()), Surface.TERRAIN, np.uint8), driveways=np.zeros((2, bins()), bool),
        island=np.zeros(bins(), np.float32),
    )  # fmt: skip


class Planner:
    """Places objects where nothing stands yet. Work in (x, offset) coordinates, sides mirrored by ``sign``."""

    def __init__(self, rng: np.random.Generator, street: Street) -> None:
        self.rng = rng
        self.street = street
        self.actors: list[Actor] = []
        self._taken: list[tuple[float, float, float, float]] = []
        self._things = 0

    def sign(self, side: int) -> float:
        """−1 on the right, +1 on the left."""
        return 1.0 if side == LEFT else -1.0

    def edge(self, side: int) -> float:
        """Centre line to the outer edge of the pavement, metres."""
        return self.street.half_width + self.street.verge[side] + self.street.walk[side]

    def near_crossing(self, x: float, margin: float) -> bool:
        """Whether a place lies in the side street or within a margin of it."""
        return abs(x - self.street.cross_x) < self.street.cross_half + margin

    def chance(self, probability: float) -> bool:
        """A biased coin."""
        return bool(self.rng.random() < probability)

    def claim(self, x: float, offset: float, length: float, width: float) -> bool:
        """Reserve a rectangle, or return False where something stands already."""
        wanted = (x - length / 2, x + length / 2, offset - width / 2, offset + width / 2)
        for other in self._taken:
            if wanted[0] < other[1] and other[0] < wanted[1] and wanted[2] < other[3] and other[2] < wanted[3]:
                return False
        self._taken.append(wanted)
        return True

    def stuff(self, category: str, parts: list[Part], x: float, offset: float, heading: float = 0.0) -> None:
        """Add an object without instance; the caller has claimed its place."""
        self.actors.append(Actor(category, parts, Motion(x, offset, heading=heading)))

    def small(self, category: str, parts: list[Part], x: float, offset: float, heading: float, room: float) -> None:
        """Add a small standing object where there is room for it."""
        if self.claim(x, offset, room, room):
            self.stuff(category, parts, x, offset, heading)

    def thing(
        self, category: str, made: tuple[list[Part], Size], x: float, offset: float, heading: float = 0.0,
        speed: float = 0.0, attribute: str = "", claim: bool = True,
    ) -> bool:  # fmt: skip
        """Add an instance; with ``claim`` only where its box fits."""
        parts, size = made
        quarter = abs(np.sin(heading)) > 0.7
        length, width = (size[0], size[1]) if quarter else (size[1], size[0])
        if claim and not self.claim(x, offset, length + 0.3, width + 0.1):
            return False
        counted = NUSCENES_RAW_TO_16[category] != 0
        self._things += counted
        motion = Motion(x, offset, speed, heading)
        self.actors.append(Actor(category, parts, motion, size, attribute, self._things if counted else 0))
        return True

    # ---- lots behind the pavement

    def lots(self, side: int) -> None:
        """Houses, car parks, parks and building sites, one after the other."""
        fillers: tuple[tuple[float, Callable[[int, float, float], None]], ...] = (
            (0.56, self._houses), (0.2, self._park), (0.14, self._car_park), (0.1, self._site),
        )  # fmt: skip
        x = X_MIN + 5
        while x < X_MAX - 30:
            length = float(self.rng.uniform(13, 24))
            if self.near_crossing(x + length / 2, length / 2 + 4):
                x += 4
                continue
            pick = int(self.rng.choice(len(fillers), p=[p for p, _ in fillers]))
            fillers[pick][1](side, x, x + length)
            x += length + float(self.rng.uniform(0.0, 3.0))
        for x in np.arange(X_MIN - 60, X_MAX + 60, 30):  # what closes the view further back
            if not self.near_crossing(float(x), 18):
                depth = 12.0
                at = self.sign(side) * (self.edge(side) + 42 + 10 * self.rng.random())
                parts = furniture.house(self.rng, 24 + 4 * float(self.rng.random()), depth)
                self.stuff("static.manmade", parts, float(x), at, 0.0 if side == LEFT else np.pi)

    def _houses(self, side: int, start: float, stop: float) -> None:
        setback = float(self.rng.choice([0.3, 1.5, 4.0, 6.0]))
        depth, edge, sign = 11.0, self.edge(side), self.sign(side)
        paved = setback < 1 or self.chance(0.3)
        self.street.lots[side, span(start - 1, stop + 2)] = Surface.SIDEWALK if paved else Surface.TERRAIN
        heading = 0.0 if side == LEFT else np.pi
        middle = (start + stop) / 2
        if not self.claim(middle, sign * (edge + setback + depth / 2), stop - start, depth):
            return
        parts = furniture.house(self.rng, stop - start, depth)
        self.stuff("static.manmade", parts, middle, sign * (edge + setback + depth / 2), heading)
        if setback >= 4:
            for x in np.arange(start + 1.5, stop - 1, 3.2):
                at = sign * (edge + setback * float(self.rng.uniform(0.4, 0.7)))
                self.small("static.vegetation", furniture.bush(self.rng), float(x), at, 0.0, 1.8)
            if self.chance(0.5):
                length = (stop - start) * 0.7
                made = furniture.hedge(self.rng, length) if self.chance(0.5) else furniture.wall(self.rng, length)
                kind = "static.vegetation" if made[0].look == Look.LEAVES else "static.manmade"
                if self.claim(middle, sign * (edge + 0.6), length, 0.8):
                    self.stuff(kind, made, middle, sign * (edge + 0.6))
            if self.chance(0.6):  # a drive with a car on it
                x = float(self.rng.uniform(start + 3, stop - 3))
                self.street.driveways[side, span(x - 1.7, x + 1.7)] = True
                self.thing(
                    "vehicle.car", vehicles.car(self.rng), x, sign * (edge + 2.8), sign * np.pi / 2,
                    attribute="vehicle.parked",
                )  # fmt: skip

    def _park(self, side: int, start: float, stop: float) -> None:
        self.street.lots[side, span(start, stop)] = Surface.TERRAIN
        edge, sign = self.edge(side), self.sign(side)
        for _ in range(int((stop - start) / 1.6)):
            x, at = float(self.rng.uniform(start, stop)), sign * (edge + float(self.rng.uniform(1.2, 26)))
            made = furniture.tree(self.rng) if self.chance(0.55) else furniture.bush(self.rng)
            self.small("static.vegetation", made, x, at, float(self.rng.uniform(0, 6)), 2.2)
        if self.chance(0.5):
            length = stop - start - 1
            if self.claim((start + stop) / 2, sign * (edge + 0.5), length, 0.8):
                made = furniture.hedge(self.rng, length) if self.chance(0.5) else furniture.wall(self.rng, length)
                kind = "static.vegetation" if made[0].look == Look.LEAVES else "static.manmade"
                self.stuff(kind, made, (start + stop) / 2, sign * (edge + 0.5))

    def _car_park(self, side: int, start: float, stop: float) -> None:
        self.street.lots[side, span(start, stop)] = Surface.ROAD
        edge, sign = self.edge(side), self.sign(side)
        self.street.driveways[side, span((start + stop) / 2 - 2, (start + stop) / 2 + 2)] = True
        for row in (3.2, 13.5, 18.9):
            x = start + 1.5
            while x < stop - 1:
                if self.chance(0.82) and not (row < 4 and abs(x - (start + stop) / 2) < 3):
                    made, category = vehicles.car(self.rng), "vehicle.car"
                    if self.chance(0.06):
                        made, category = vehicles.motorcycle(self.rng, ridden=False), "vehicle.motorcycle"
                    heading = float(self.rng.choice([-1, 1])) * np.pi / 2 + float(self.rng.normal(0, 0.03))
                    at = sign * (edge + row + float(self.rng.normal(0, 0.15)))
                    self.thing(category, made, x, at, heading, attribute=parked(category))
                x += float(self.rng.uniform(2.4, 2.75))

    def _site(self, side: int, start: float, stop: float) -> None:
        self.street.lots[side, span(start, stop)] = Surface.OTHER if self.chance(0.5) else Surface.TERRAIN
        edge, sign = self.edge(side), self.sign(side)
        style = int(self.rng.integers(3))
        for x in np.arange(start + 1, stop - 0.5, 1.95):
            made = furniture.barrier(self.rng, style)
            self.thing("movable_object.barrier", made, float(x), sign * (edge + 0.6), np.pi / 2)
        middle = (start + stop) / 2
        machine = vehicles.excavator(self.rng)
        spin = float(self.rng.choice([0, np.pi / 2, np.pi]))
        self.thing("vehicle.construction", machine, middle, sign * (edge + 6), spin, attribute="vehicle.stopped")
        if self.chance(0.7):
            self.thing(
                "vehicle.trailer",
                vehicles.trailer(self.rng),
                start + 4.5,
                sign * (edge + 12),
                attribute="vehicle.parked",
            )
        if self.chance(0.7):
            self.thing(
                "vehicle.truck", vehicles.truck(self.rng), stop - 5, sign * (edge + 11.5), attribute="vehicle.parked"
            )
        if self.claim(middle, sign * (edge + 17), 6.5, 3):
            self.stuff("static.manmade", furniture.container(self.rng), middle, sign * (edge + 17))
        for _ in range(int(self.rng.integers(1, 4))):
            x, at = float(self.rng.uniform(start, stop)), sign * (edge + float(self.rng.uniform(1.5, 9)))
            made = pedestrian(self.rng, worker=True)
            turned = float(self.rng.uniform(-3, 3))
            self.thing("human.pedestrian.construction_worker", made, x, at, turned, attribute="pedestrian.standing")
        for x in np.arange(start + 0.5, stop, 2.6):
            made = furniture.cone(self.rng)
            self.thing("movable_object.trafficcone", made, float(x), sign * (edge + 1.5 + float(self.rng.random())))


def parked(category: str) -> str:
    """The attribute of a vehicle that stands without driver."""
    return "cycle.without_rider" if category in ("vehicle.bicycle", "vehicle.motorcycle") else "vehicle.parked"
