"""The instance ids of a scene by a preset's rule (paper, section III-D, step 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import ScanLabels
from l3ps.presets import Preset
from l3ps.refine.instances import correct_instances, geometric_instances
from l3ps.refine.objects import scene_instances


@dataclass(frozen=True, slots=True)
class Objects:
    """Classes and ids after the instance step.

    Attributes:
        semantic: (N,) uint8 class; the instance step may give an object's points one class.
        instance: (N,) int32 id, 0 for stuff and void.
    """

    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]


def identify(
    points: NDArray[np.float32],
    bounds: NDArray[np.integer],
    ground: NDArray[np.bool_],
    semantic: NDArray[np.uint8],
    primal: Sequence[ScanLabels],
    poses: NDArray[np.float64],
    times: NDArray[np.float64],
    preset: Preset,
) -> Objects:
    """Tell the objects of a scene apart.

    Args:
        points: (N, 3) float32, metres, scene frame, z up.
        bounds: (S + 1,) where each scan begins among the points, and N.
        ground: (N,) bool partition.
        semantic: (N,) uint8 class after the vote.
        primal: the primal labels, scan by scan.
        poses: (S, 4, 4) float64 lidar → scene.
        times: (S,) float64 seconds.
        preset: which rule: that of the paper or objects of a scan get ids that hold within the scan, objects of the
            scene ids that hold throughout.

    Returns:
        The objects.
    """
    if preset.instances == "scene":
        before = np.concatenate([labels.semantic for labels in primal])
        instance, semantic = scene_instances(
            points, bounds, ground, semantic, before, poses[:, :3, 3], times, one_class=preset.instance_class
        )
        return Objects(semantic, instance)
    instance = np.zeros(len(points), dtype=np.int32)
    for labels, part in zip(primal, map(slice, bounds[:-1], bounds[1:]), strict=True):
        if preset.instances == "published":
            instance[part] = correct_instances(points[part], labels.semantic, labels.instance, semantic[part])
        else:
            instance[part] = geometric_instances(points[part], semantic[part], preset.instance_gap)
    return Objects(semantic, instance)
