"""The labels of one scan as they travel between the stages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

ONE_VOTE = 100
"""Weight of one camera's full vote in :class:`Evidence`; 255 then holds two and a half, more than cameras overlap."""
CANDIDATES = 3
"""Classes kept a point. On simulated and real drives the third carries under 2 % of the probability."""


class Provenance(IntEnum):
    """Where a refined point's class comes from; written beside the labels, so numbers are never reused.

    ``NONE``: void, nothing is known. ``CAMERA``: the point's own pixels settled it. ``NEIGHBOURS``: the points within
    some decimetres, over all scans. ``CLUSTER``: its geometric cluster. ``NOISE_FILL``: the cluster that noise was
    given to. ``GROUND_RULE``: the ground around it, which few or no cameras saw here; or its pixels said what ground
    cannot be, or what nothing else can. ``INSTANCE_RULE``: the object it belongs to.
    """

    NONE = 0
    CAMERA = 1
    NEIGHBOURS = 2
    CLUSTER = 3
    NOISE_FILL = 4
    GROUND_RULE = 5
    INSTANCE_RULE = 6


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the cameras say of a scan's points: the most likely classes and how much each weighs.

    Attributes:
        classes: (N, 3) uint8 ``NUSCENES16`` class, heaviest first; void is a class like any other.
        weights: (N, 3) uint8, 100 = one camera's undoubted vote; 0 where there is no (further) candidate.
        cameras: (N,) uint8 cameras whose image the point falls into and that are not blocked by a nearer surface.
        agree: (N,) bool, whether all of these see the same class; True where there are fewer than two.
    """

    classes: NDArray[np.uint8]
    weights: NDArray[np.uint8]
    cameras: NDArray[np.uint8]
    agree: NDArray[np.bool_]

    @classmethod
    def of_labels(cls, semantic: NDArray[np.uint8]) -> Evidence:
        """Evidence of labels without probabilities: each class but void is one full vote.

        Args:
            semantic: (N,) uint8 class.
        """
        classes = np.zeros((len(semantic), CANDIDATES), dtype=np.uint8)
        weights = np.zeros_like(classes)
        classes[:, 0] = semantic
        weights[:, 0] = np.where(semantic > 0, ONE_VOTE, 0)
        seen = (semantic > 0).astype(np.uint8)
        return cls(classes, weights, seen, np.ones(len(semantic), dtype=bool))


@dataclass(frozen=True, slots=True)
class ScanLabels:
    """Panoptic labels of one scan, in point-file order, in the ``NUSCENES16`` space.

    Attributes:
        token: the scan's token.
        semantic: (N,) uint8 class, 0 = void.
        instance: (N,) int32 id, 0 = none; one id never names two objects of a scan.
        evidence: of primal labels, what the cameras said beyond the labels; None where nobody kept it.
        confidence: of refined labels, (N,) uint8, 255 = certain: estimated probability that the class is right.
        provenance: of refined labels, (N,) uint8, a :class:`Provenance` a point.
    """

    token: str
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    evidence: Evidence | None = None
    confidence: NDArray[np.uint8] | None = None
    provenance: NDArray[np.uint8] | None = None
