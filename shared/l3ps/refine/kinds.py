"""What is known of the thing classes before any image is seen: which are taken for one another, and how large they are.

The sizes are bounds, not averages: nothing that is a bus is under 2.5 m high, no car is over 7.5 m long. They are wider
than the objects (the longest car with a box in the recordings has 6 m), as labels bleed onto what stands around one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps.taxonomy import NUSCENES16

CLASSES = len(NUSCENES16.classes)


@dataclass(frozen=True, slots=True)
class Size:
    """Bounds of the visible part of an object of a class, metres.

    ``least`` is the length in the bird's-eye view that some scan shows of an object that several scans see from near.
    """

    length: float
    width: float
    lowest: float
    highest: float
    least: float = 0.0


SIZES: dict[str, Size] = {
    "barrier": Size(3.0, 1.3, 0.5, 1.5),
    "bicycle": Size(2.4, 1.3, 0.6, 2.1),
    "bus": Size(14.0, 3.8, 2.5, 4.5, 5.0),
    "car": Size(7.5, 3.5, 0.9, 2.3, 2.5),
    "construction_vehicle": Size(10.0, 4.5, 1.8, 5.0, 2.5),
    "motorcycle": Size(2.8, 1.6, 0.7, 2.1),
    "pedestrian": Size(1.4, 1.4, 0.8, 2.2),
    "traffic_cone": Size(1.0, 1.0, 0.3, 1.3),
    "trailer": Size(14.0, 3.8, 1.7, 4.5, 2.5),
    "truck": Size(12.0, 3.8, 1.7, 4.5, 2.5),
}


@dataclass(frozen=True, slots=True)
class Kind:
    """Classes whose points can be one object before it is decided which.

    Attributes:
        classes: their names.
        gap: metres within which points of one scan belong together near the sensor.
        near: the same for all scans of a scene laid over each other, which leave smaller gaps.
        join: metres within which two parts of a standing object may lie.
        speed: m/s, faster than anything of the kind goes.
        follows: objects of kinds that share this number may be one object in different scans.
    """

    classes: tuple[str, ...]
    gap: float
    near: float
    join: float
    speed: float
    follows: int


KINDS: tuple[Kind, ...] = (
    Kind(("bus", "car", "construction_vehicle", "trailer", "truck"), 0.9, 0.5, 1.5, 16.0, 1),
    Kind(("bicycle", "motorcycle"), 0.5, 0.35, 0.8, 9.0, 2),
    Kind(("pedestrian",), 0.4, 0.3, 0.5, 2.6, 2),
    Kind(("traffic_cone",), 0.4, 0.3, 0.5, 0.5, 3),
    Kind(("barrier",), 0.5, 0.3, 0.6, 0.5, 4),
)
"""A cyclist is a pedestrian in one scan and a bicycle in the next, so the two follow each other."""


def _of_class(attribute: str, missing: float) -> NDArray[np.float64]:
    return np.array([getattr(SIZES[name], attribute) if name in SIZES else missing for name in NUSCENES16.classes])


LENGTH, WIDTH = _of_class("length", np.inf), _of_class("width", np.inf)
LEAST = _of_class("least", 0.0)
LOWEST, HIGHEST = _of_class("lowest", 0.0), _of_class("highest", np.inf)
KIND_OF = np.full(CLASSES, -1)
"""(17,) kind of each class, -1 for stuff and void."""
for _number, _kind in enumerate(KINDS):
    KIND_OF[[NUSCENES16.index(name) for name in _kind.classes]] = _number

_UNFIT = 0.15
"""What a vote counts for a class that the object is too large, too high, too low or too short for."""
_SHORT = 0.35
"""What it counts for a class that the object is too short for, where few scans saw it and it may be the end of one.
0.5 and 1 leave a pedestrian of a real keyframe a car (IoU -5.0); simulated drives (seeds 21 to 24) do not tell them
apart."""
_LONGER, _WIDER, _HIGHER, _LOWER = 1.1, 1.15, 1.05, 0.9
"""How far out of its bounds an object must be to be unfit."""


def likely_class(
    votes: NDArray[np.floating],
    height: NDArray[np.floating],
    length: NDArray[np.floating] | None = None,
    width: NDArray[np.floating] | None = None,
    longest: NDArray[np.floating] | None = None,
    well_seen: NDArray[np.bool_] | None = None,
) -> NDArray[np.intp]:
    """The thing class with the most votes among those that fit an object's size.

    Args:
        votes: (K, 17) votes for each class; those for stuff do not count.
        height: (K,) top of the object above the ground, metres.
        length: (K,) of its rectangle in the bird's-eye view, metres; None where it is not to decide.
        width: (K,) likewise.
        longest: (K,) its length where it is seen from near, elsewhere infinite; None likewise.
        well_seen: (K,) whether several scans saw it, so that its length is known; None: nothing is.

    Returns:
        (K,) class.
    """
    unfit = (height[:, None] > HIGHEST * _HIGHER) | (height[:, None] < LOWEST * _LOWER)
    if length is not None:
        unfit |= length[:, None] > LENGTH * _LONGER
    if width is not None:
        unfit |= width[:, None] > WIDTH * _WIDER
    fitness = np.where(unfit, _UNFIT, 1.0)
    if longest is not None:
        sure = np.zeros(len(votes), dtype=bool) if well_seen is None else well_seen
        short = longest[:, None] < LEAST
        fitness = np.minimum(fitness, np.where(short, np.where(sure, _UNFIT, _SHORT)[:, None], 1.0))
    weighed = (votes + 1e-3) * fitness
    return np.asarray(np.where(NUSCENES16.is_thing, weighed, -1.0).argmax(axis=1))


def too_large(
    votes: NDArray[np.floating], height: NDArray[np.floating], length: NDArray[np.floating], width: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """(K,) whether an object is larger than its class allows, going by its votes and height.

    Its length has no say in the class here: something long and low is a row of cars, not a bus.
    """
    chosen = likely_class(votes, height)
    return np.asarray((length > LENGTH[chosen]) | (width > WIDTH[chosen]))
