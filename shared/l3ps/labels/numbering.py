"""Instance ids that fit into a file format's field, consistent over a scene."""

from __future__ import annotations

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

    Ids that fit are kept as they are. Otherwise each code's objects are numbered from 1: scan by scan, by id.

    Args:
        scene: the scene's name, for messages.
        labels: the scene's scans in order.
        code: (17,) the class each class becomes in the format; those that become one share its numbers.
        limit: largest id the format can hold.
        keep: (17,) classes that carry ids in the format; the others get 0.

    Returns:
        (N,) int64 ids, one array a scan.

    Raises:
        LabelError: a code has more than ``limit`` objects in the scene.
    """
    kept = [np.where(keep[scan.semantic], scan.instance, 0).astype(np.int64) for scan in labels]
    if all(ids.size == 0 or int(ids.max()) <= limit for ids in kept):
        return kept
    numbers: dict[int, dict[int, int]] = {}
    fitted = []
    for scan, ids in zip(labels, kept, strict=True):
        keys, position = np.unique(code[scan.semantic].astype(np.int64) << 32 | ids, return_inverse=True)
        renumbered = np.zeros(len(keys), dtype=np.int64)
        for row, key in enumerate(keys.tolist()):
            of_code = numbers.setdefault(key >> 32, {})
            identity = key & 0xFFFFFFFF
            renumbered[row] = of_code.setdefault(identity, len(of_code) + 1) if identity else 0
        fitted.append(renumbered[position])
    for written, of_code in numbers.items():
        if len(of_code) > limit:
            name = NUSCENES16.classes[int(np.flatnonzero((code == written) & keep)[0])]
            raise LabelError(
                Problem(
                    code="too-many-instances",
                    where=f"scene {scene}",
                    what=f"has {len(of_code):,} instances of {name}, the label format holds {limit:,}",
                    remedy="Split the scene into shorter ones.",
                    scene=scene,
                )
            )
    return fitted
