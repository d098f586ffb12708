"""Label spaces and the mappings between them: the only place that knows class numbers.

The method works in ``NUSCENES16``: 0 is void, 1–16 are the classes of the Panoptic nuScenes challenge. Truth in
nuScenes logs comes in the 32 raw categories and is mapped on reading; predictions are written in challenge indices.
SemanticKITTI labels are read and written in its raw ids and evaluated in its 19 classes.

A panoptic value is ``class * 1000 + instance`` with instance 0 for stuff and for "no instance".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

VOID = 0
INSTANCE_FACTOR = 1000
"""Panoptic nuScenes packs a segment as class * 1000 + instance (Fong et al. 2022)."""


@dataclass(frozen=True)
class LabelSpace:
    """Classes of one label space; index 0 is void.

    Attributes:
        name: the space's name, as used in files and figures.
        classes: class names by index, ``classes[0] == "void"``.
        things: indices of the thing classes.
        rare: indices favoured by the vote, in the order in which the published code tries them.
        ground: indices of the classes that are ground.
        colors: one RGB triple a class, the colours the field is used to.
    """

    name: str
    classes: tuple[str, ...]
    things: frozenset[int]
    rare: tuple[int, ...]
    ground: frozenset[int]
    colors: tuple[tuple[int, int, int], ...] = field(repr=False)

    @cached_property
    def is_thing(self) -> NDArray[np.bool_]:
        """(C,) bool, True where a class is a thing."""
        mask = np.zeros(len(self.classes), dtype=bool)
        mask[list(self.things)] = True
        return mask

    @cached_property
    def is_ground(self) -> NDArray[np.bool_]:
        """(C,) bool, True where a class is ground."""
        mask = np.zeros(len(self.classes), dtype=bool)
        mask[list(self.ground)] = True
        return mask

    @cached_property
    def palette(self) -> NDArray[np.uint8]:
        """(C, 3) uint8 RGB."""
        return np.asarray(self.colors, dtype=np.uint8)

    def index(self, name: str) -> int:
        """Index of a class by name; ValueError when the space has no such class."""
        return self.classes.index(name)


NUSCENES16 = LabelSpace(
    name="nuscenes",
    classes=(
        "void",
        "barrier",
        "bicycle",
        "bus",
        "car",
        "construction_vehicle",
        "motorcycle",
        "pedestrian",
        "traffic_cone",
        "trailer",
        "truck",
        "driveable_surface",
        "other_flat",
        "sidewalk",
        "terrain",
        "manmade",
        "vegetation",
    ),
    things=frozenset(range(1, 11)),
    rare=(3, 5, 6, 9, 12, 13),
    ground=frozenset({11, 12, 13, 14}),
    colors=(
        (0, 0, 0),
        (112, 128, 144),
        (220, 20, 60),
        (255, 127, 80),
        (255, 158, 0),
        (233, 150, 70),
        (255, 61, 99),
        (0, 0, 230),
        (47, 79, 79),
        (255, 140, 0),
        (255, 99, 71),
        (0, 207, 191),
        (175, 0, 75),
        (75, 0, 75),
        (112, 180, 60),
        (222, 184, 135),
        (0, 175, 0),
    ),
)

NUSCENES_RAW_TO_16: dict[str, int] = {
    "animal": 0,
    "human.pedestrian.adult": 7,
    "human.pedestrian.child": 7,
    "human.pedestrian.construction_worker": 7,
    "human.pedestrian.personal_mobility": 0,
    "human.pedestrian.police_officer": 7,
    "human.pedestrian.stroller": 0,
    "human.pedestrian.wheelchair": 0,
    "movable_object.barrier": 1,
    "movable_object.debris": 0,
    "movable_object.pushable_pullable": 0,
    "movable_object.trafficcone": 8,
    "noise": 0,
    "static_object.bicycle_rack": 0,
    "vehicle.bicycle": 2,
    "vehicle.bus.bendy": 3,
    "vehicle.bus.rigid": 3,
    "vehicle.car": 4,
    "vehicle.construction": 5,
    "vehicle.ego": 0,
    "vehicle.emergency.ambulance": 0,
    "vehicle.emergency.police": 0,
    "vehicle.motorcycle": 6,
    "vehicle.trailer": 9,
    "vehicle.truck": 10,
    "flat.driveable_surface": 11,
    "flat.other": 12,
    "flat.sidewalk": 13,
    "flat.terrain": 14,
    "static.manmade": 15,
    "static.other": 0,
    "static.vegetation": 16,
}
"""The 32 raw categories → challenge class (nuScenes lidarseg challenge definition)."""

NUSCENES_RAW_INDEX: tuple[str, ...] = (
    "noise",
    "animal",
    "human.pedestrian.adult",
    "human.pedestrian.child",
    "human.pedestrian.construction_worker",
    "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer",
    "human.pedestrian.stroller",
    "human.pedestrian.wheelchair",
    "movable_object.barrier",
    "movable_object.debris",
    "movable_object.pushable_pullable",
    "movable_object.trafficcone",
    "static_object.bicycle_rack",
    "vehicle.bicycle",
    "vehicle.bus.bendy",
    "vehicle.bus.rigid",
    "vehicle.car",
    "vehicle.construction",
    "vehicle.emergency.ambulance",
    "vehicle.emergency.police",
    "vehicle.motorcycle",
    "vehicle.trailer",
    "vehicle.truck",
    "flat.driveable_surface",
    "flat.other",
    "flat.sidewalk",
    "flat.terrain",
    "static.manmade",
    "static.other",
    "static.vegetation",
    "vehicle.ego",
)
"""Raw category names in the order of the published ``category.json`` index."""

SEMANTICKITTI19 = LabelSpace(
    name="semantickitti",
    classes=(
        "void",
        "car",
        "bicycle",
        "motorcycle",
        "truck",
        "other-vehicle",
        "person",
        "bicyclist",
        "motorcyclist",
        "road",
        "parking",
        "sidewalk",
        "other-ground",
        "building",
        "fence",
        "vegetation",
        "trunk",
        "terrain",
        "pole",
        "traffic-sign",
    ),
    things=frozenset(range(1, 9)),
    rare=(),
    ground=frozenset({9, 10, 11, 12, 17}),
    colors=(
        (0, 0, 0),
        (100, 150, 245),
        (100, 230, 245),
        (30, 60, 150),
        (80, 30, 180),
        (0, 0, 255),
        (255, 30, 30),
        (255, 40, 200),
        (150, 30, 90),
        (255, 0, 255),
        (255, 150, 255),
        (75, 0, 75),
        (175, 0, 75),
        (255, 200, 0),
        (255, 120, 50),
        (0, 175, 0),
        (135, 60, 0),
        (150, 240, 80),
        (255, 240, 150),
        (255, 0, 0),
    ),
)

SEMANTICKITTI_RAW_TO_19: dict[int, int] = {
    0: 0, 1: 0, 10: 1, 11: 2, 13: 5, 15: 3, 16: 5, 18: 4, 20: 5, 30: 6, 31: 7, 32: 8, 40: 9, 44: 10, 48: 11, 49: 12,
    50: 13, 51: 14, 52: 0, 60: 9, 70: 15, 71: 16, 72: 17, 80: 18, 81: 19, 99: 0, 252: 1, 253: 7, 254: 6, 255: 8,
    256: 5, 257: 5, 258: 4, 259: 5,
}  # fmt: skip
"""Raw SemanticKITTI id → its 19 training classes (semantic-kitti.yaml, learning_map)."""

SEMANTICKITTI_19_TO_RAW: tuple[int, ...] = (
    0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81,
)  # fmt: skip
"""The 19 training classes → the raw id written for each (learning_map_inv)."""

NUSCENES16_TO_SEMANTICKITTI19: tuple[int, ...] = (0, 14, 2, 5, 1, 5, 3, 6, 0, 5, 4, 9, 12, 11, 17, 13, 15)
"""Challenge class → nearest of the 19: bus, trailer, construction vehicle → other-vehicle; barrier → fence;
manmade → building (poles and signs are lost in it); traffic cone has no counterpart and becomes void."""

SEMANTICKITTI19_TO_NUSCENES16: tuple[int, ...] = (
    0, 4, 2, 6, 10, 0, 7, 2, 6, 11, 11, 13, 12, 15, 15, 16, 16, 14, 15, 15,
)  # fmt: skip
"""The 19 → nearest challenge class; riders count to their vehicle as in nuScenes. Void for other-vehicle, which may be
a bus, a trailer or a tram: no single class is right for it, and a wrong truth is worse than none."""

NUSCENES16_TO_SEMANTICKITTI_RAW: tuple[int, ...] = (
    0, 51, 11, 13, 10, 20, 15, 30, 99, 20, 18, 40, 49, 48, 72, 50, 70,
)  # fmt: skip
"""Challenge class → raw id written for it. Finer than the 19 where the raw ids are: bus is 13 (bus), a traffic cone 99
(other-object); both fall where ``NUSCENES16_TO_SEMANTICKITTI19`` puts them once the learning map is applied."""

_SEMANTICKITTI_RAW_VEHICLES: dict[int, int] = {13: 3, 257: 3}
"""Raw ids of other-vehicle that do say which challenge class: bus and moving bus."""


def nuscenes_raw_lut(category_index: dict[str, int]) -> NDArray[np.uint8]:
    """Lookup table raw category index → challenge class.

    Args:
        category_index: category name → index, from the log's ``category.json``.

    Returns:
        (256,) uint8; unknown indices map to void.
    """
    lut = np.zeros(256, dtype=np.uint8)
    for name, index in category_index.items():
        lut[index] = NUSCENES_RAW_TO_16.get(name, VOID)
    return lut


def semantickitti_raw_lut() -> NDArray[np.uint8]:
    """(65536,) uint8 lookup table raw SemanticKITTI id → 19 classes; unknown ids map to void."""
    lut = np.zeros(1 << 16, dtype=np.uint8)
    for raw, train in SEMANTICKITTI_RAW_TO_19.items():
        lut[raw] = train
    return lut


def semantickitti_raw_to_nuscenes16_lut() -> NDArray[np.uint8]:
    """(65536,) uint8 lookup table raw SemanticKITTI id → challenge class; what has no counterpart maps to void."""
    lut = np.asarray(SEMANTICKITTI19_TO_NUSCENES16, dtype=np.uint8)[semantickitti_raw_lut()]
    for raw, index in _SEMANTICKITTI_RAW_VEHICLES.items():
        lut[raw] = index
    return lut


def pack(semantic: NDArray[np.integer], instance: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Panoptic value ``class * 1000 + instance`` per point.

    Args:
        semantic: (N,) class indices.
        instance: (N,) instance ids, 0 for none, below 1000.

    Returns:
        (N,) uint32.
    """
    if instance.size and int(instance.max()) >= INSTANCE_FACTOR:
        raise ValueError(f"instance id {int(instance.max())} does not fit class * {INSTANCE_FACTOR} + instance")
    return semantic.astype(np.uint32) * INSTANCE_FACTOR + instance.astype(np.uint32)


def unpack(panoptic: NDArray[np.integer]) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Inverse of :func:`pack`: ((N,) uint8 class, (N,) int32 instance)."""
    semantic, instance = np.divmod(panoptic, INSTANCE_FACTOR)
    return semantic.astype(np.uint8), instance.astype(np.int32)
