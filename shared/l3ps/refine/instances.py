"""Instance ids after the vote has changed classes (paper, section III-D, step 5; METHOD 3.5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from l3ps.taxonomy import NUSCENES16


def correct_instances(
    xyz: NDArray[np.float32],
    primal_semantic: NDArray[np.uint8],
    primal_instance: NDArray[np.int32],
    semantic: NDArray[np.uint8],
) -> NDArray[np.int32]:
    """Mend the ids of one scan as published.

    A point whose class did not change keeps its id. A point whose class changed to a thing takes the id of the nearest
    kept thing point of the scan, of any thing class; if there is none, all such points share one new id.

    Args:
        xyz: (N, 3) float32, metres, any frame.
        primal_semantic: (N,) uint8 class before the vote.
        primal_instance: (N,) int32 id before the vote.
        semantic: (N,) uint8 class after the vote.

    Returns:
        (N,) int32 id, 0 for stuff and void.
    """
    thing = NUSCENES16.is_thing[semantic]
    same = primal_semantic == semantic
    kept = thing & same
    changed = thing & ~same
    instance = np.where(kept, primal_instance, 0).astype(np.int32)
    if changed.any():
        if kept.any():
            _, nearest = cKDTree(xyz[kept]).query(xyz[changed])
            instance[changed] = instance[kept][nearest]
        else:
            instance[changed] = primal_instance.max(initial=0) + 1
    return instance
