"""What is on and beside the carriageway: parked rows, moving traffic, people, street furniture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import furniture, vehicles
from .layout import CYCLING, LANE, SIDES, WALKING, Planner, draw_street, parked
from .parts import Part, turn
from .people import pedestrian
from .street import LEFT, X_MAX, X_MIN, span
from .textures import NoiseTiles
from .world import Light, Motion, World

Made = tuple[list[Part], tuple[float, float, float]]


def build_world(rng: np.random.Generator, duration: float) -> World:
    """A street scene with the ego car at its start.

    Args:
        rng: source of everything.
        duration: how long the recording takes, seconds; bounds the ego's speed so that it stays in the built street.
    """
    street = draw_street(rng)
    plan = Planner(rng, street)
    speed = min(float(rng.uniform(4.0, 9.0)), 220.0 / max(duration, 1.0))
    start = float(rng.uniform(-75, -35))
    for side in SIDES:
        plan.lots(side)
        _kerbside(plan, side)
        _furniture(plan, side)
        _people(plan, side)
    _islands(plan)
    _side_street(plan)
    _traffic(plan, start, speed)
    slope, across, bearing = rng.normal(0, 0.006), rng.normal(0, 0.004), rng.uniform(-np.pi, np.pi)
    return World(
        street, tuple(plan.actors), Light.draw(rng), NoiseTiles.make(rng), Motion(start, -LANE, speed),
        _on_the_map(slope, across, bearing),
    )  # fmt: skip


def _on_the_map(slope: float, across: float, bearing: float) -> NDArray[np.float64]:
    """(4, 4) street → world."""
    pose = np.eye(4)
    pose[:3, :3] = turn(bearing, slope, across)
    pose[:3, 3] = 250.0, 250.0, 0.0
    return pose


def _parked_vehicle(plan: Planner) -> tuple[str, Made]:
    rng = plan.rng
    pick = rng.random()
    if pick < 0.84:
        return "vehicle.car", vehicles.car(rng)
    if pick < 0.89:
        return "vehicle.truck", vehicles.truck(rng)
    if pick < 0.94:
        return "vehicle.trailer", vehicles.trailer(rng)
    return "vehicle.motorcycle", vehicles.motorcycle(rng, ridden=False)


def _kerbside(plan: Planner, side: int) -> None:
    """A row of parked vehicles with small gaps, a bus stop and a stretch of roadworks in between."""
    rng, sign, half = plan.rng, plan.sign(side), plan.street.half_width
    works = float(rng.uniform(-50, 40)) if plan.chance(0.6) else 1e6
    stop = float(rng.uniform(-50, 50)) if plan.chance(0.5) else 1e6
    free = float(rng.uniform(0.1, 0.45))  # some streets are parked up, others give a view of the pavement
    x = X_MIN + 10
    while x < X_MAX - 20:
        if plan.near_crossing(x + 3, 9):
            x += 3
        elif works < x:
            works, x = 1e6, _roadworks(plan, side, x)
        elif stop < x:
            made = vehicles.bus(rng)
            length = made[1][1]
            heading = 0.0 if side != LEFT else np.pi
            at = sign * (half - 0.3 - made[1][0] / 2)
            plan.thing("vehicle.bus.rigid", made, x + length / 2, at, heading, attribute="vehicle.stopped")
            _waiting(plan, side, x + length / 2)
            stop, x = 1e6, x + length + 2.5
        elif plan.chance(free):
            x += float(rng.uniform(4, 12))
        else:
            category, made = _parked_vehicle(plan)
            width, length, _ = made[1]
            heading = (0.0 if side != LEFT else np.pi) + float(rng.normal(0, 0.015))
            at = sign * (half - 0.2 - width / 2 - 0.15 * rng.random())
            plan.thing(category, made, x + length / 2, float(at), heading, attribute=parked(category))
            x += length + float(rng.uniform(0.5, 1.1))


def _roadworks(plan: Planner, side: int, x: float) -> float:
    """Cones on the taper, a row of barriers, perhaps a machine; returns where the stretch ends."""
    rng, sign, half = plan.rng, plan.sign(side), plan.street.half_width
    style = int(rng.integers(3))
    for i in range(4):
        made = furniture.cone(rng)
        plan.thing("movable_object.trafficcone", made, x + 0.9 * i, sign * (half - 0.4 - 0.6 * i))
    row = x + 4.5
    for i in range(int(rng.integers(4, 8))):
        made = furniture.barrier(rng, style)
        plan.thing("movable_object.barrier", made, row + 1.95 * i, sign * (half - 2.4), np.pi / 2)
        end = row + 1.95 * i
    if plan.chance(0.4):
        machine = vehicles.excavator(rng)
        plan.thing("vehicle.construction", machine, (row + end) / 2, sign * (half - 0.85), attribute="vehicle.stopped")
    for _ in range(2):
        made = pedestrian(rng, worker=True)
        at = sign * (half - float(rng.uniform(0.6, 1.5)))
        spot = float(rng.uniform(row, end))
        plan.thing("human.pedestrian.construction_worker", made, spot, at, 1.0, attribute="pedestrian.standing")
    return end + 3.0


def _waiting(plan: Planner, side: int, x: float) -> None:
    """A group at a bus stop."""
    edge = plan.edge(side)
    for i in range(int(plan.rng.integers(3, 7))):
        at = plan.sign(side) * (edge - 0.2 + 0.25 * float(plan.rng.normal()))
        made = pedestrian(plan.rng)
        turned = float(plan.rng.uniform(-3, 3))
        plan.thing("human.pedestrian.adult", made, x + 0.75 * i, at, turned, attribute="pedestrian.standing")


def _furniture(plan: Planner, side: int) -> None:
    """Trees, lamps, signs, bollards, cabinets, bins and bicycle racks along the kerb."""
    rng, sign = plan.rng, plan.sign(side)
    inner = plan.street.half_width + 0.75
    spacing = float(rng.uniform(7.5, 11))
    trees = plan.chance(0.75)
    for i, x in enumerate(np.arange(X_MIN + 6, X_MAX - 6, spacing)):
        if plan.near_crossing(float(x), 3):
            continue
        toward = 0.0 if side == LEFT else np.pi
        if i % 3 == 0:
            plan.small("static.manmade", furniture.lamp(rng), float(x), sign * inner, toward, 0.8)
        elif trees and plan.chance(0.8):
            plan.small("static.vegetation", furniture.tree(rng), float(x), sign * inner, float(rng.uniform(0, 6)), 0.8)
        beside = float(x) + 1.6
        maker = [furniture.sign, furniture.bollard, furniture.cabinet, furniture.bollard][int(rng.integers(4))]
        if plan.chance(0.5) and not plan.near_crossing(beside, 1):
            plan.small("static.manmade", maker(rng), beside, sign * (inner - 0.2), toward, 0.5)
        if plan.chance(0.22):
            made = furniture.bin_(rng)
            plan.thing("movable_object.pushable_pullable", made, beside + 1.5, sign * inner)
        if plan.chance(0.22) and plan.claim(beside + 3.4, sign * (inner + 0.1), 4.2, 1.3):
            plan.stuff("static_object.bicycle_rack", furniture.rack(rng), beside + 3.4, sign * (inner + 0.1))
            for k in range(int(rng.integers(1, 5))):
                made = vehicles.bicycle(rng, ridden=False)
                plan.thing(
                    "vehicle.bicycle", made, beside + 2.0 + 0.72 * k, sign * (inner + 0.1), np.pi / 2,
                    attribute="cycle.without_rider", claim=False,
                )  # fmt: skip
    for corner in (-1, 1):
        x = plan.street.cross_x + corner * (plan.street.cross_half + 1.0)
        plan.small("static.manmade", furniture.traffic_light(rng), x, sign * (inner - 0.1), 0.0, 0.5)


def _people(plan: Planner, side: int) -> None:
    """Two streams along the pavement, alone and in groups, and people who stand about."""
    rng, sign, edge = plan.rng, plan.sign(side), plan.edge(side)
    for direction, lane in ((1, edge - 0.8), (-1, edge - 1.95)):
        x = X_MIN + 25 + 30 * float(rng.random())
        while x < X_MAX - 60:
            for i in range(int(rng.choice([1, 2, 3, 4], p=[0.4, 0.35, 0.15, 0.1]))):
                child = plan.chance(0.15)
                at = lane + (0.3 if i % 2 else -0.3) + 0.05 * float(rng.normal())
                category = "human.pedestrian.child" if child else "human.pedestrian.adult"
                plan.thing(
                    category, pedestrian(rng, child), x + 0.95 * (i // 2) + 0.1 * float(rng.normal()), sign * at,
                    0.0 if direction > 0 else np.pi, direction * WALKING, "pedestrian.moving", claim=False,
                )  # fmt: skip
            x += float(rng.uniform(6, 26))
    for x in np.arange(X_MIN + 20, X_MAX - 40, 17.0):
        if plan.chance(0.5):
            spot = float(x) + float(rng.uniform(0, 10))
            for i in range(int(rng.integers(1, 4))):
                made = pedestrian(rng, plan.chance(0.1))
                at = sign * (edge + 0.05 + 0.1 * float(rng.random()))
                turned = float(rng.uniform(-3, 3))
                plan.thing("human.pedestrian.adult", made, spot + 0.8 * i, at, turned, attribute="pedestrian.standing")


def _islands(plan: Planner) -> None:
    """Traffic islands in the middle of the street with a sign or bollards on them."""
    rng, street = plan.rng, plan.street
    for x in np.arange(X_MIN + 10, X_MAX - 40, 45.0):
        start = float(x) + float(rng.uniform(0, 15))
        length = float(rng.uniform(8, 24))
        if plan.chance(0.75) and not plan.near_crossing(start + length / 2, length / 2 + 2):
            half = float(rng.uniform(0.5, 0.8))
            street.island[span(start, start + length)] = half
            plan.stuff("static.manmade", furniture.sign(rng), start + 0.5, 0.0)
            plan.stuff("static.manmade", furniture.sign(rng), start + length - 0.5, 0.0, np.pi)
            if plan.chance(0.5):
                for at in np.arange(start + 3, start + length - 2, 2.5):
                    plan.stuff("static.manmade", furniture.bollard(rng), float(at), 0.0)


def _side_street(plan: Planner) -> None:
    """Cars that wait in the side street and houses that close its view."""
    rng, street = plan.rng, plan.street
    for side in SIDES:
        sign = plan.sign(side)
        for i in range(int(rng.integers(1, 4))):
            at = sign * (street.half_width + 5.5 + 6.5 * i)
            made = vehicles.car(rng) if plan.chance(0.8) else vehicles.truck(rng)
            category = "vehicle.car" if made[1][2] < 2.3 and made[1][1] < 6 else "vehicle.truck"
            lane = street.cross_x + sign * street.cross_half * 0.5
            plan.thing(category, made, lane, at, -sign * np.pi / 2, attribute="vehicle.stopped")
        end = furniture.house(rng, 40.0, 10.0)
        plan.stuff("static.manmade", end, street.cross_x, sign * 95, 0.0 if side == LEFT else np.pi)


def _traffic(plan: Planner, start: float, speed: float) -> None:
    """Both lanes and the cyclists beside them. All of one lane keep one speed and so their distance."""
    rng, half = plan.rng, plan.street.half_width

    def draw() -> tuple[str, Made, str]:
        pick = rng.random()
        if pick < 0.74:
            return "vehicle.car", vehicles.car(rng), "vehicle.moving"
        if pick < 0.84:
            return "vehicle.truck", vehicles.truck(rng), "vehicle.moving"
        if pick < 0.92:
            return "vehicle.bus.rigid", vehicles.bus(rng), "vehicle.moving"
        return "vehicle.motorcycle", vehicles.motorcycle(rng, ridden=True), "cycle.with_rider"

    lanes = (
        (start + float(rng.uniform(11, 22)), X_MAX - 30, -LANE, speed, 0.0),
        (X_MIN - 10, start - 12, -LANE, speed, 0.0),
        (X_MIN + 10, X_MAX + 120, LANE, -float(rng.uniform(4, 9)), np.pi),
    )
    for first, end, offset, pace, heading in lanes:
        x = first
        while x < end:
            category, made, attribute = draw()
            if x + made[1][1] > end:
                break
            plan.thing(category, made, x + made[1][1] / 2, offset, heading, pace, attribute, claim=False)
            x += made[1][1] + float(rng.uniform(5, 32))
    for sign, pace in ((-1, CYCLING), (1, -CYCLING)):
        x = X_MIN + 40 * float(rng.random())
        while x < X_MAX:
            made = vehicles.bicycle(rng, ridden=True)
            at = sign * (half - 3.1)
            heading = 0.0 if pace > 0 else np.pi
            plan.thing("vehicle.bicycle", made, x, at, heading, pace, "cycle.with_rider", claim=False)
            x += float(rng.uniform(9, 45))
