"""One class an object: what touches and is of one kind is one thing (an addition to the paper's section III-D).

A network that has seen few buses calls a bus truck at one end and car at the other, and clusters of a few decimetres
cannot know better. The points of a scan that are of one kind (any motor vehicle, say) and lie together choose the
class that has the most votes among them, each with what all scans said of its place.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import CANDIDATES, ONE_VOTE
from l3ps.refine.consensus import CLASSES, Opinion
from l3ps.refine.instances import geometric_instances
from l3ps.taxonomy import NUSCENES16

KINDS: tuple[frozenset[str], ...] = (
    frozenset({"bus", "car", "construction_vehicle", "trailer", "truck"}),
    frozenset({"bicycle", "motorcycle"}),
)
"""Classes that are taken for one another; an object of one kind never takes a class of another, so that a person who
leans on a car stays one."""


def objects_of_a_kind(
    points: NDArray[np.float32], bounds: NDArray[np.integer], semantic: NDArray[np.uint8], gap: float
) -> NDArray[np.int32]:
    """Number the objects of each scan, taking all classes of a kind for one.

    Args:
        points: (N, 3) float32, metres, scene frame, z up.
        bounds: (S + 1,) where each scan begins, and N.
        semantic: (N,) uint8 class.
        gap: points of a kind closer than this in x and y, in metres, belong to one object.

    Returns:
        (N,) int32 number from 1, unique over the scans; 0 for classes of no kind.
    """
    found = np.zeros(len(points), dtype=np.int32)
    taken = 0
    of_kind = _KIND[semantic]
    for begin, end in pairwise(bounds.tolist()):
        ids = geometric_instances(points[begin:end], of_kind[begin:end], gap)
        found[begin:end] = np.where(ids > 0, ids + taken, 0)
        taken += int(ids.max(initial=0))
    return found


def vote_by_object(
    found: NDArray[np.int32], opinion: Opinion, own: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Let each object settle on one class of its kind.

    Args:
        found: (N,) int32 number of each point's object, 0 = none. Points of one number may lie in several scans, but
            are of one kind.
        opinion: on each point.
        own: votes that the neighbourhood's opinion counts for beside the point's own.

    Returns:
        (N,) uint8 class, and (N,) float32 its share of the votes: in an object, of the point's votes for the kind times
        the object's votes for the class; elsewhere the opinion's.
    """
    semantic, share = opinion.semantic.copy(), opinion.share.copy()
    member = np.flatnonzero(found)
    if len(member) == 0:
        return semantic, share
    votes = own * opinion.belief[opinion.cell[member]]
    for rank in range(CANDIDATES):
        weight = opinion.counted.weights[member, rank].astype(np.float32) / ONE_VOTE
        votes[np.arange(len(member)), opinion.counted.classes[member, rank]] += weight
    votes /= np.maximum(votes.sum(axis=1, keepdims=True), 1e-6)  # a point near the sensor speaks no louder
    votes[_KIND[None, :] != _KIND[opinion.semantic[member], None]] = 0
    number = found[member]
    classes = np.flatnonzero(_KIND)
    total = np.stack([np.bincount(number, weights=votes[:, c]) for c in classes], axis=1)
    semantic[member] = classes[total.argmax(axis=1)][number]
    share[member] = (total.max(axis=1) / np.maximum(total.sum(axis=1), 1e-6))[number] * votes.sum(axis=1)
    return semantic, share


def _kinds() -> NDArray[np.uint8]:
    """(17,) uint8 the first class of each class's kind, 0 where it has none."""
    kind = np.zeros(CLASSES, dtype=np.uint8)
    for names in KINDS:
        members = sorted(NUSCENES16.index(name) for name in names)
        kind[members] = members[0]
    return kind


_KIND = _kinds()
