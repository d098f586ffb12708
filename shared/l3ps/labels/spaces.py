"""Panoptic labels carried from one label space into another without merging or splitting objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l3ps.taxonomy import (
    NUSCENES16,
    NUSCENES16_TO_SEMANTICKITTI19,
    SEMANTICKITTI19,
    SEMANTICKITTI19_TO_NUSCENES16,
    LabelSpace,
)

SPACES: dict[str, LabelSpace] = {space.name: space for space in (NUSCENES16, SEMANTICKITTI19)}
"""The label spaces that truth and predictions come in, by name."""

_TABLES: dict[tuple[str, str], tuple[int, ...]] = {
    (NUSCENES16.name, SEMANTICKITTI19.name): NUSCENES16_TO_SEMANTICKITTI19,
    (SEMANTICKITTI19.name, NUSCENES16.name): SEMANTICKITTI19_TO_NUSCENES16,
}


def convert(
    semantic: NDArray[np.uint8], instance: NDArray[np.integer], source: str, target: str
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Labels of one space in the classes of another.

    Args:
        semantic: (N,) class indices of the source space.
        instance: (N,) ids, 0 = none, unique within a class.
        source: name of the space the labels are in.
        target: name of the space they are wanted in.

    Returns:
        (N,) uint8 classes and (N,) int64 ids of the target space.
    """
    if source == target:
        return semantic, instance.astype(np.int64)
    converted = np.asarray(_TABLES[source, target], dtype=np.uint8)[semantic]
    return converted, instances_in(converted, semantic, instance, SPACES[target])


def instances_in(
    converted: NDArray[np.uint8],
    original: NDArray[np.integer],
    instance: NDArray[np.integer],
    space: LabelSpace,
) -> NDArray[np.int64]:
    """Ids that stay apart when several classes become one, and vanish where a thing becomes stuff.

    A bicyclist and a bicycle may both carry id 3; as two bicycles they need two ids. A row of barriers that becomes
    fence is one segment of fence.

    Args:
        converted: (N,) class in ``space``.
        original: (N,) class before, below 32.
        instance: (N,) id before, 0 = none, unique within an original class.
        space: the space of ``converted``.

    Returns:
        (N,) int64 ids, unique within a converted class.
    """
    keep = space.is_thing[converted] & (instance > 0)
    return np.where(keep, instance.astype(np.int64) << 5 | original.astype(np.int64), 0)
