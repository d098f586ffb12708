"""Instance ids that fit into a file format's field, consistent over a scene."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from l3ps.errors import LabelError, Problem
from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import NUSCENES16


def fitted_instances(
    scene: str, labels: Sequence[ScanLabels], code: NDArray[np.integer], limit: int, keep: NDArray[np.bool_]
) -> list[NDArray[np.int64]]:
    """Ids of a scene's scans that are at most ``limit``, the same object keeping one id through the scene.

    Ids that fit are kept as they are. Otherwise each code's objects are numbered from 1: scan by scan, by id. Where a
    code has more than ``limit`` of them, those seen in one scan alone are numbered scan by scan above the others, so
    that only they share numbers.

    Args:
        scene: the scene's name, for messages.
        labels: the scene's scans in order.
        code: (17,) the class each class becomes in the format; those that become one share its numbers.
        limit: largest id the format can hold.
        keep: (17,) classes that carry ids in the format; the others get 0.

    Returns:
        (N,) int64 ids, one array a scan.

    Raises:
        LabelError: a code has more than ``limit`` objects in a scan, together with those seen in several scans.
    """
    kept = [np.where(keep[scan.semantic], scan.instance, 0).astype(np.int64) for scan in labels]
    if all(ids.size == 0 or int(ids.max()) <= limit for ids in kept):
        return kept
    keys, position = _keys(labels, kept, code)
    objects, scans = np.unique(np.concatenate(keys), return_counts=True)
    scans_of = dict(zip(objects.tolist(), scans.tolist(), strict=True))
    owners = np.unique(objects >> 32, return_counts=True)
    crowded = {written for written, count in zip(*(a.tolist() for a in owners), strict=True) if count > limit}
    numbers: dict[int, int] = {}
    used: dict[int, int] = defaultdict(int)
    for key in (key for of_scan in keys for key in of_scan.tolist()):
        if key not in numbers and (key >> 32 not in crowded or scans_of[key] > 1):
            used[key >> 32] += 1
            numbers[key] = used[key >> 32]
    fitted = []
    most = dict(used)
    for of_scan, places in zip(keys, position, strict=True):
        own = dict(used)
        renumbered = np.zeros(len(of_scan) + 1, dtype=np.int64)
        for row, key in enumerate(of_scan.tolist(), start=1):
            if key not in numbers:
                own[key >> 32] = own.get(key >> 32, 0) + 1
            renumbered[row] = numbers.get(key, own.get(key >> 32, 0))
        most = {written: max(count, most.get(written, 0)) for written, count in own.items()}
        fitted.append(renumbered[places])
    for written, count in most.items():
        if count > limit:
            name = NUSCENES16.classes[int(np.flatnonzero((code == written) & keep)[0])]
            raise LabelError(
                Problem(
                    code="too-many-instances",
                    where=f"scene {scene}",
                    what=f"has {count:,} instances of {name}, the label format holds {limit:,}",
                    remedy="Split the scene into shorter ones.",
                    scene=scene,
                )
            )
    return fitted


def _keys(
    labels: Sequence[ScanLabels], kept: Sequence[NDArray[np.int64]], code: NDArray[np.integer]
) -> tuple[list[NDArray[np.int64]], list[NDArray[np.intp]]]:
    """Per scan its objects as ``code << 32 | id``, ascending, and for each point 1 + its object's index, 0 for none."""
    keys, position = [], []
    for scan, ids in zip(labels, kept, strict=True):
        has = ids > 0
        found, of = np.unique(code[scan.semantic[has]].astype(np.int64) << 32 | ids[has], return_inverse=True)
        places = np.zeros(len(ids), dtype=np.intp)
        places[has] = of + 1
        keys.append(found)
        position.append(places)
    return keys, position
