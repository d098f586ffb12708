"""Whether an object keeps its id from scan to scan."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Truth
from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import NUSCENES16, VOID

MIN_POINTS = 15
"""Points an object needs in a scan to count as seen there: the ``nuscenes`` protocol's smallest segment."""
MIN_SCANS = 5
"""Scans in which an object must be seen to be one that an id can be followed through."""


@dataclass(frozen=True, slots=True)
class IdConsistency:
    """How predicted ids follow the true objects of one or more scenes; figures of scenes add up.

    Attributes:
        objects: true objects of at least ``MIN_POINTS`` points in at least ``MIN_SCANS`` scans of their scene.
        followed: those of them that match a predicted object in at least two scans, so that an id can be kept or lost.
        kept: those followed whose matches all carry one id.
        exclusive: those kept whose id matches no other object of ``objects`` in any scan.
        scans: sum over ``objects`` of the scans in which they are seen.
        matched: those of them in which the object matches a predicted one.
    """

    objects: int = 0
    followed: int = 0
    kept: int = 0
    exclusive: int = 0
    scans: int = 0
    matched: int = 0

    def __add__(self, other: IdConsistency) -> IdConsistency:
        return IdConsistency(
            self.objects + other.objects,
            self.followed + other.followed,
            self.kept + other.kept,
            self.exclusive + other.exclusive,
            self.scans + other.scans,
            self.matched + other.matched,
        )

    def as_dict(self) -> dict[str, float | int | None]:
        """Counts, and shares in per cent.

        ``one_id`` is ``kept`` of ``followed``, ``one_id_exclusive`` is ``exclusive`` of ``followed``, and
        ``one_id_of_all`` is ``kept`` of ``objects``: an object that no prediction matches twice counts against it.
        """
        return {
            "objects": self.objects,
            "followed": self.followed,
            "kept": self.kept,
            "exclusive": self.exclusive,
            "scans": self.scans,
            "matched": self.matched,
            "one_id": _percent(self.kept, self.followed),
            "one_id_exclusive": _percent(self.exclusive, self.followed),
            "one_id_of_all": _percent(self.kept, self.objects),
            "scans_matched": _percent(self.matched, self.scans),
        }


def id_consistency(
    truth: Sequence[Truth], labels: Sequence[ScanLabels], *, min_points: int = MIN_POINTS, min_scans: int = MIN_SCANS
) -> IdConsistency:
    """Follow each true object of a scene through its scans.

    In a scan, an object matches the predicted id with which its points have an intersection over union above 0.5, as
    PQ matches segments, but whatever the class: a wrong class does not lose an object. Points void in the truth are
    left out.

    Args:
        truth: the scene's truth in the ``NUSCENES16`` space, one a scan; an id names one object of a class throughout.
        labels: predictions for the same scans; an id names one object whatever its class.
        min_points: points an object needs in a scan to be seen there.
        min_scans: scans in which an object must be seen to count.

    Raises:
        ValueError: truth and labels differ in their number of scans or points.
    """
    if len(truth) != len(labels):
        raise ValueError(f"{len(truth)} scans with truth and {len(labels)} with labels")
    seen: dict[int, int] = defaultdict(int)
    matches: dict[int, list[int]] = defaultdict(list)
    for true, predicted in zip(truth, labels, strict=True):
        if true.semantic.shape != predicted.instance.shape:
            raise ValueError(f"{len(true.semantic)} points with truth and {len(predicted.instance)} with labels")
        for key, identity in _matches_of_scan(true, predicted.instance, min_points):
            seen[key] += 1
            if identity:
                matches[key].append(identity)
    objects = [key for key, count in seen.items() if count >= min_scans]
    owners: dict[int, set[int]] = defaultdict(set)
    for key in objects:
        for identity in matches[key]:
            owners[identity].add(key)
    followed = [key for key in objects if len(matches[key]) >= 2]
    kept = [key for key in followed if len(set(matches[key])) == 1]
    return IdConsistency(
        objects=len(objects),
        followed=len(followed),
        kept=len(kept),
        exclusive=sum(len(owners[matches[key][0]]) == 1 for key in kept),
        scans=sum(seen[key] for key in objects),
        matched=sum(len(matches[key]) for key in objects),
    )


def _matches_of_scan(truth: Truth, predicted: NDArray[np.int32], min_points: int) -> list[tuple[int, int]]:
    """Each true object seen in a scan as ``class << 32 | id``, and the predicted id that matches it or 0."""
    valid = truth.semantic != VOID
    ids = predicted[valid].astype(np.int64)
    own = NUSCENES16.is_thing[truth.semantic[valid]] & (truth.instance[valid] > 0)
    key = np.where(own, truth.semantic[valid].astype(np.int64) << 32 | truth.instance[valid], 0)
    if not own.any():
        return []
    keys, key_of, key_size = np.unique(key, return_inverse=True, return_counts=True)
    names, name_of, name_size = np.unique(ids, return_inverse=True, return_counts=True)
    pairs, common = np.unique(key_of.astype(np.int64) * len(names) + name_of, return_counts=True)
    left, right = pairs // len(names), pairs % len(names)
    hit = (common / (key_size[left] + name_size[right] - common) > 0.5) & (names[right] > 0)
    found = np.zeros(len(keys), dtype=np.int64)
    found[left[hit]] = names[right[hit]]
    large = (key_size >= min_points) & (keys > 0)
    return list(zip(keys[large].tolist(), found[large].tolist(), strict=True))


def _percent(part: int, whole: int) -> float | None:
    return 100 * part / whole if whole else None
