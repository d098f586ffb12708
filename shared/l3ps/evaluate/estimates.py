"""How good a scan's labels are, estimated without truth: do the votes, the scans and the cameras agree?

The estimate is there to rank scans, so that a person looks at the doubtful ones first; it is no forecast of PQ. It is
the geometric mean of some shares, chosen on simulated drives (seeds 21 to 24, 20 scans each, labels of preset
``best``). Spearman's rank correlation with a scan's true PQ, mean of the four drives and over all 80 scans:

    ==============================================  ======  =====
    purity, both consistencies, support               0.52   0.73
    consistency of the things with other scans        0.48   0.38
    consistency of all points                         0.42   0.47
    support by other scans                            0.35   0.37
    purity of the clusters, mean of the classes       0.30   0.62
    purity of the clusters, mean of the points       -0.13
    share of points that kept their primal class     -0.22
    PQ of the refined labels against the primal       0.06
    ==============================================  ======  =====

The mean hides a drive without any rank (seeds 21 to 24: 0.67, 0.57, 0.78, 0.06). Where the labels carry a confidence,
its mean of the classes is a fifth share: it takes 0.51 and 0.63 (labels with all of ``best``'s parts) to 0.52 and
0.66, and the correlation with mIoU from 0.26 and 0.57 to 0.40 and 0.67. The agreement of the cameras (0.12 and 0.31
alone) is told beside the estimate but left out of it: with it, 0.43 and 0.62.

It is made of the classes after the vote, while the points of a chunk are at hand; the instance step changes few of
them. Made of the classes after it, it ranks the same: 0.42 and 0.67 against 0.42 and 0.68 (PQ of the final labels, same
drives, mean of the drives and all scans).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import NUSCENES16, VOID

CELL = 0.3
"""Edge in metres of the cells in which scans are compared. 0.2, 0.3, 0.4 and 0.5 m give a correlation of 0.50, 0.52,
0.48 and 0.43."""
SAMPLE = 300_000
"""Points of a scene that are compared. Twice as many change the correlation by less than 0.01; two thirds lose 0.02."""
FEWEST = 15
"""Points of a class in a scan, below which it does not count, as in the official evaluation."""

_CLASSES = len(NUSCENES16.classes)


@dataclass(frozen=True, slots=True)
class ScanEstimate:
    """What speaks for the labels of one scan; all are shares in 0..1, None where nothing can be told.

    Attributes:
        token: the scan's token.
        estimate: the geometric mean of the next five, of those that are known: ranks the scans of a drive.
        purity: share of the votes in its points' clusters that went to the winner, mean of the classes.
        consistency: points whose class is that which other scans give most often in the same place.
        thing_consistency: the same of things alone.
        support: points in places that another scan of the scene has seen and labelled.
        confidence: what the labels say of themselves, mean of the classes.
        unvoted: points whose cluster got no vote at all.
        cameras: points seen by two cameras whose classes agree.
    """

    token: str
    estimate: float | None
    purity: float | None
    consistency: float | None
    thing_consistency: float | None
    support: float | None
    confidence: float | None
    unvoted: float | None
    cameras: float | None = None

    def as_dict(self) -> dict[str, str | float | None]:
        """Plain data, for JSON."""
        return asdict(self)


def estimate_scene(
    points: NDArray[np.float32],
    cluster: NDArray[np.int32],
    primal: Sequence[ScanLabels],
    refined: NDArray[np.uint8],
    confidence: NDArray[np.uint8] | None = None,
) -> list[ScanEstimate]:
    """:func:`estimate_scans` of labels as they come out of the vote.

    Args:
        points: (N, 3) float32, metres, scene frame.
        cluster: (N,) int32 cluster, -1 for none.
        primal: the labels before the vote, scan by scan.
        refined: (N,) uint8 class after it.
        confidence: (N,) uint8, 255 = certain; None where there is none.
    """
    if not primal:
        return []
    seen = [seen_twice(s.evidence.cameras, s.evidence.agree) for s in primal if s.evidence is not None]
    return estimate_scans(
        [s.token for s in primal],
        np.cumsum([0, *(len(s.semantic) for s in primal)]),
        points,
        cluster,
        np.concatenate([s.semantic for s in primal]),
        refined,
        np.concatenate(seen) if len(seen) == len(primal) else None,
        confidence,
    )


def estimate_scans(
    tokens: Sequence[str],
    bounds: NDArray[np.int64],
    points: NDArray[np.float32],
    cluster: NDArray[np.int32],
    primal: NDArray[np.uint8],
    refined: NDArray[np.uint8],
    cameras_agree: NDArray[np.int8] | None = None,
    confidence: NDArray[np.uint8] | None = None,
) -> list[ScanEstimate]:
    """Estimate the quality of the scans of one scene.

    Args:
        tokens: of the S scans.
        bounds: (S + 1,) first point of each scan, and N.
        points: (N, 3) float32, metres, scene frame.
        cluster: (N,) int32 cluster, -1 for none.
        primal: (N,) uint8 class before the vote, 0 where no camera saw the point.
        refined: (N,) uint8 class.
        cameras_agree: (N,) int8: 1 where the cameras that saw a point gave it one class, 0 where not, -1 where fewer
            than two saw it (:func:`seen_twice`); None where that is not known.
        confidence: (N,) uint8, 255 = certain; None where the labels carry none.

    Returns:
        One estimate a scan.
    """
    purity, unvoted = _purities(cluster, primal)
    consistent = _consistencies(bounds, points, refined)
    estimates = []
    for index, token in enumerate(tokens):
        own = slice(bounds[index], bounds[index + 1])
        member = cluster[own] >= 0
        ids, classes = cluster[own][member], refined[own][member]
        sums = np.bincount(classes, purity[ids], _CLASSES)
        voted = np.bincount(classes, ~unvoted[ids], _CLASSES)
        counted = np.bincount(classes, minlength=_CLASSES) >= FEWEST
        counted[VOID] = False
        pure = _mean((sums / np.maximum(voted, 1))[counted])
        total, met, same, things, same_things = consistent[index]
        support = _share(met, total) if len(tokens) > 1 else None
        sure = None
        if confidence is not None:
            sums = np.bincount(refined[own], confidence[own], _CLASSES)
            number = np.bincount(refined[own], minlength=_CLASSES)
            sure = _mean((sums / (255.0 * np.maximum(number, 1)))[counted])
        parts = (pure, _share(same, met), _share(same_things, things), support, sure)
        known = np.array([part for part in parts if part is not None])
        cameras = None
        if cameras_agree is not None:
            agree = cameras_agree[own]
            cameras = _mean(agree[agree >= 0])
        estimates.append(
            ScanEstimate(
                token,
                float(np.prod(known) ** (1 / len(known))) if len(known) else None,
                *parts,
                _mean(unvoted[ids]),
                cameras,
            )
        )
    return estimates


def seen_twice(cameras: NDArray[np.uint8], agree: NDArray[np.bool_]) -> NDArray[np.int8]:
    """(N,) int8: whether the cameras that see a point agree, -1 where fewer than two do.

    Args:
        cameras: (N,) uint8 number of cameras that see the point.
        agree: (N,) bool, whether they see one class.
    """
    return np.where(cameras >= 2, agree, -1).astype(np.int8)


def mean_estimates(scans: Iterable[Mapping[str, object]]) -> dict[str, float] | None:
    """Each figure's mean over the scans that have it; None where no scan has any.

    Args:
        scans: :meth:`ScanEstimate.as_dict` of each.

    Returns:
        Shares in 0..1 by name, and under ``scans`` how many have an estimate.
    """
    known: dict[str, list[float]] = {}
    for scan in scans:
        for name, value in scan.items():
            if isinstance(value, int | float):
                known.setdefault(name, []).append(float(value))
    if "estimate" not in known:
        return None
    means = {name: sum(values) / len(values) for name, values in known.items()}
    return means | {"scans": float(len(known["estimate"]))}


def rank_correlation(estimates: Sequence[float | None], truths: Sequence[float | None]) -> float | None:
    """Spearman's rank correlation of two figures of the same scans; ties share their mean rank.

    Returns:
        -1..1, or None where fewer than three scans have both figures, or one of them is the same for all.
    """
    pairs = [(a, b) for a, b in zip(estimates, truths, strict=True) if a is not None and b is not None]
    if len(pairs) < 3:
        return None
    ranks = [_ranks(np.array(values, dtype=np.float64)) for values in zip(*pairs, strict=True)]
    spread = [float(r.std()) for r in ranks]
    if 0.0 in spread:
        return None
    return float(np.mean((ranks[0] - ranks[0].mean()) * (ranks[1] - ranks[1].mean())) / (spread[0] * spread[1]))


def _purities(cluster: NDArray[np.int32], primal: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(K,) share of the winner among a cluster's votes, 0 where it has none; (K,) whether it has none."""
    number = int(cluster.max(initial=-1)) + 1
    voting = (cluster >= 0) & (primal != VOID)
    cell = cluster[voting].astype(np.int64) * _CLASSES + primal[voting]
    counts = np.bincount(cell, minlength=number * _CLASSES).reshape(number, _CLASSES)
    votes = counts.sum(axis=1)
    return counts.max(axis=1, initial=0) / np.maximum(votes, 1), votes == 0


def _consistencies(
    bounds: NDArray[np.int64], points: NDArray[np.float32], refined: NDArray[np.uint8]
) -> NDArray[np.int64]:
    """(S, 5) per scan: points looked at; those with another scan's in their cell; those whose class is the cell's most
    frequent in other scans; things with another scan's in their cell; those of them whose class is.
    """
    scans = len(bounds) - 1
    step = max(1, -(-len(points) // SAMPLE))
    scan = np.searchsorted(bounds, np.arange(0, len(points), step), side="right") - 1
    sample, label = points[::step], refined[::step]
    # What is void, or not finite, says nothing and is not asked.
    usable = np.isfinite(sample).all(axis=1) & (label != VOID)
    scan, sample, label = scan[usable], sample[usable], label[usable]
    if len(sample) == 0:
        return np.zeros((scans, 5), dtype=np.int64)
    index = np.floor((sample - sample.min(axis=0)) / CELL).astype(np.int64)
    extent = index.max(axis=0) + 1
    _, cell = np.unique((index[:, 0] * extent[1] + index[:, 1]) * extent[2] + index[:, 2], return_inverse=True)
    total = np.bincount(cell * _CLASSES + label, minlength=(int(cell.max()) + 1) * _CLASSES).reshape(-1, _CLASSES)
    pair, row = np.unique(cell * scans + scan, return_inverse=True)
    own = np.bincount(row * _CLASSES + label, minlength=len(pair) * _CLASSES).reshape(-1, _CLASSES)
    others = total[pair // scans] - own
    met = others.any(axis=1)[row]
    same = met & (others.argmax(axis=1)[row] == label)
    thing = NUSCENES16.is_thing[label]
    counts = (np.ones(len(scan), dtype=bool), met, same, met & thing, same & thing)
    return np.stack([np.bincount(scan[mask], minlength=scans) for mask in counts], axis=1)


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    _, position, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return np.asarray((last - (count - 1) / 2)[position], dtype=np.float64)


def _share(part: int, whole: int) -> float | None:
    return float(part / whole) if whole else None


def _mean(values: NDArray[np.generic]) -> float | None:
    return float(np.mean(values.astype(np.float64))) if len(values) else None
