"""Panoptic quality and IoU from counts that add up over scans, scenes and machines.

The counting follows the official Panoptic nuScenes evaluation (nuscenes-devkit 1.2.0, ``PanopticEval``), which follows
semantic-kitti-api: a segment is the set of a scan's points with the same class and instance id, instance 0 included;
a predicted and a true segment of one class match at IoU > 0.5 whatever their size; unmatched ones count as false
positive or false negative from the protocol's minimum size on; points void in the truth are dropped before anything
is counted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Truth
from l3ps.evaluate.protocols import protocol_named
from l3ps.evaluate.quality import ClassQuality, Quality

_COUNTS = ("confusion", "tp", "fp", "fn", "truth_segments", "unscorable")


class PanopticEvaluator:
    """Accumulates scans under one protocol; two accumulators of disjoint scans can be merged.

    Args:
        protocol: a name in :data:`l3ps.evaluate.PROTOCOLS`.

    Raises:
        ValueError: the protocol is unknown.
    """

    def __init__(self, protocol: str) -> None:
        self.protocol = protocol_named(protocol)
        n = len(self.protocol.space.classes)
        self.confusion: NDArray[np.int64] = np.zeros((n, n), dtype=np.int64)
        """[truth class, predicted class] points."""
        self.iou_sum: NDArray[np.float64] = np.zeros(n)
        self.tp: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self.fp: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self.fn: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self.truth_segments: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self.unscorable: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        """Scans with points of a thing class but without instances: they make that class' PQ unknown."""
        self.scans = 0
        self.points = 0
        self.unlabelled = 0

    def add(self, truth: Truth, pred_semantic: NDArray[np.integer], pred_instance: NDArray[np.integer]) -> None:
        """Count one scan.

        Args:
            truth: the scan's truth in the protocol's label space.
            pred_semantic: (N,) predicted class in the same space, 0 = void.
            pred_instance: (N,) predicted id, at least 0, unique within a class.

        Raises:
            ValueError: the arrays differ in length, or hold a class outside the space or a negative id.
        """
        n_classes = len(self.protocol.space.classes)
        arrays = (truth.semantic, truth.instance, pred_semantic, pred_instance)
        if len({a.shape for a in arrays}) != 1 or truth.semantic.ndim != 1:
            raise ValueError(f"truth and prediction must be flat and of one length, got {[a.shape for a in arrays]}")
        for semantic in (truth.semantic, pred_semantic):
            if semantic.size and not 0 <= int(semantic.min()) <= int(semantic.max()) < n_classes:
                found = f"{int(semantic.min())}–{int(semantic.max())}"
                raise ValueError(f"classes {found} exceed label space {self.protocol.space.name!r}, 0–{n_classes - 1}")

        valid = truth.semantic != 0
        if not valid.any():
            self.scans += 1
            return
        truth_class = truth.semantic[valid].astype(np.int64)
        pred_class = pred_semantic[valid].astype(np.int64)
        truth_key, truth_base = _segment_keys(truth_class, truth.instance[valid])
        pred_key, pred_base = _segment_keys(pred_class, pred_instance[valid])
        # One sort of the pairs; everything below works on the few thousand distinct ones.
        span = n_classes * pred_base
        pairs, size = np.unique(truth_key * span + pred_key, return_counts=True)
        truth_id, truth_of = np.unique(pairs // span, return_inverse=True)
        pred_id, pred_of = np.unique(pairs % span, return_inverse=True)
        truth_class, pred_class = truth_id // truth_base, pred_id // pred_base

        # A class the prediction abstains from must stay in the means: count before dropping predicted void.
        self.scans += 1
        large = _areas(truth_of, size, len(truth_id)) >= self.protocol.min_points
        self.truth_segments += np.bincount(truth_class[large], minlength=n_classes)
        void = pred_class[pred_of] == 0
        self.points += int(size.sum())
        self.unlabelled += int(size[void].sum())
        if self.protocol.ignore_predicted_void:
            size = np.where(void, 0, size)
        cell = truth_class[truth_of] * n_classes + pred_class[pred_of]
        self.confusion += _areas(cell, size, n_classes * n_classes).reshape(n_classes, n_classes)
        self._match(truth_class, truth_of, pred_class, pred_of, size)
        if not truth.has_instances:
            things = np.intersect1d(truth_class, list(self.protocol.space.things))
            self.unscorable[things] += 1

    def _match(
        self,
        truth_class: NDArray[np.int64],
        truth_of: NDArray[np.intp],
        pred_class: NDArray[np.int64],
        pred_of: NDArray[np.intp],
        size: NDArray[np.int64],
    ) -> None:
        """Count matches and misses given each overlapping pair's segments and number of common points."""
        n_classes = len(self.protocol.space.classes)
        truth_area = _areas(truth_of, size, len(truth_class))
        pred_area = _areas(pred_of, size, len(pred_class))
        # An IoU over 0.5 is unique for both sides, so no assignment problem is left to solve.
        iou = size / np.maximum(truth_area[truth_of] + pred_area[pred_of] - size, 1)
        hit = (iou > 0.5) & (truth_class[truth_of] == pred_class[pred_of])
        hit_class = truth_class[truth_of[hit]]
        self.tp += np.bincount(hit_class, minlength=n_classes)
        self.iou_sum += np.bincount(hit_class, weights=iou[hit], minlength=n_classes)
        missed = truth_area >= self.protocol.min_points
        missed[truth_of[hit]] = False
        self.fn += np.bincount(truth_class[missed], minlength=n_classes)
        wrong = pred_area >= self.protocol.min_points
        wrong[pred_of[hit]] = False
        self.fp += np.bincount(pred_class[wrong], minlength=n_classes)

    def merge(self, other: PanopticEvaluator) -> None:
        """Add the counts of other scans.

        Raises:
            ValueError: the other evaluator counts under another protocol.
        """
        if other.protocol.name != self.protocol.name:
            raise ValueError(f"cannot add figures of protocol {other.protocol.name!r} to {self.protocol.name!r}")
        for name in (*_COUNTS, "iou_sum"):
            getattr(self, name)[...] += getattr(other, name)
        self.scans += other.scans
        self.points += other.points
        self.unlabelled += other.unlabelled

    def state(self) -> dict[str, Any]:
        """Everything counted so far as plain data for JSON; :meth:`from_state` restores it exactly."""
        return {
            "protocol": self.protocol.name,
            "scans": self.scans,
            "points": self.points,
            "unlabelled": self.unlabelled,
            "iou_sum": self.iou_sum.tolist(),
            **{name: getattr(self, name).tolist() for name in _COUNTS},
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> PanopticEvaluator:
        """The evaluator that :meth:`state` described.

        Raises:
            ValueError: the state is incomplete or of another number of classes.
        """
        try:
            evaluator = cls(state["protocol"])
            for name in (*_COUNTS, "iou_sum"):
                target = getattr(evaluator, name)
                values = np.asarray(state[name], dtype=target.dtype)
                if values.shape != target.shape:
                    raise ValueError(f"evaluator state has {name} of shape {values.shape}, expected {target.shape}")
                target[...] = values
            evaluator.scans, evaluator.points = int(state["scans"]), int(state["points"])
            evaluator.unlabelled = int(state["unlabelled"])
        except KeyError as error:
            raise ValueError(f"evaluator state lacks {error.args[0]!r}") from error
        return evaluator

    def quality(self) -> Quality:
        """The figures of everything counted so far."""
        hits = np.diagonal(self.confusion)
        union = self.confusion.sum(axis=0) + self.confusion.sum(axis=1) - hits
        iou = 100 * hits / np.maximum(union, 1)
        sq = 100 * self.iou_sum / np.maximum(self.tp, 1)
        rq = 100 * self.tp / np.maximum(self.tp + 0.5 * self.fp + 0.5 * self.fn, 0.5)
        classes: dict[str, ClassQuality] = {}
        for index, name in enumerate(self.protocol.space.classes):
            if index == 0:
                continue
            known = self.unscorable[index] == 0
            classes[name] = ClassQuality(
                pq=float(sq[index] * rq[index] / 100) if known else None,
                sq=float(sq[index]) if known else None,
                rq=float(rq[index]) if known else None,
                iou=float(iou[index]),
                tp=int(self.tp[index]) if known else None,
                fp=int(self.fp[index]) if known else None,
                fn=int(self.fn[index]) if known else None,
                truth_segments=int(self.truth_segments[index]),
                is_thing=index in self.protocol.space.things,
            )
        unlabelled = 100 * self.unlabelled / max(self.points, 1)
        return Quality.of(self.protocol.name, self.scans, self.points, unlabelled, classes)


def _segment_keys(semantic: NDArray[np.int64], instance: NDArray[np.integer]) -> tuple[NDArray[np.int64], int]:
    """One integer a point that names its segment, ``class * base + id``, and the base.

    Ids of 2**24 and more are renumbered, so that two keys always fit one int64.
    """
    if int(instance.min()) < 0:
        raise ValueError(f"instance id {int(instance.min())} is negative; 0 means none")
    ids = instance.astype(np.int64)
    if int(ids.max()) >= 1 << 24:
        ids = np.unique(ids, return_inverse=True)[1]
    base = int(ids.max()) + 1
    return semantic * base + ids, base


def _areas(index: NDArray[np.integer], size: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Sum of ``size`` per index; exact, as float64 holds every count below 2**53."""
    return np.bincount(index, weights=size, minlength=n).astype(np.int64)
