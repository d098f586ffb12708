"""The figures of one evaluation, per class and mean, in per cent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class ClassQuality:
    """Figures of one class.

    Attributes:
        pq: panoptic quality, per cent; None where the truth has no instances to match (as sq, rq, tp, fp, fn).
        sq: mean IoU of the matched segments, per cent.
        rq: F1 score of the matching, per cent.
        iou: intersection over union of the class' points, per cent.
        tp: matched segments.
        fp: predicted segments of the protocol's minimum size without a match.
        fn: truth segments of the protocol's minimum size without a match.
        truth_segments: truth segments of the protocol's minimum size.
        is_thing: whether the class is a thing.
    """

    pq: float | None
    sq: float | None
    rq: float | None
    iou: float
    tp: int | None
    fp: int | None
    fn: int | None
    truth_segments: int
    is_thing: bool

    @property
    def counted(self) -> bool:
        """Whether the means run over this class: it has a truth segment that counts.

        That is one of the minimum size, or a smaller one that was matched: the official evaluation takes it as a true
        positive, and leaving its class out would hide it.
        """
        return self.truth_segments > 0 or bool(self.tp)


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of one evaluation. Means run over the classes with a truth segment that counts.

    Attributes:
        protocol: name of the protocol the figures were made under.
        pq: mean panoptic quality, per cent; None where a class among them has no PQ, or where there is no class.
        sq: mean segmentation quality, likewise.
        rq: mean recognition quality, likewise.
        miou: mean IoU, per cent; None where there is no class to average.
        pq_things: mean panoptic quality of the things among them, likewise.
        pq_stuff: mean panoptic quality of the stuff among them, likewise.
        scans: scans evaluated.
        points: points that are not void in the truth.
        unlabelled: per cent of these points that the prediction leaves void.
        classes: every class of the protocol's label space but void, in its order.
    """

    protocol: str
    pq: float | None
    sq: float | None
    rq: float | None
    miou: float | None
    pq_things: float | None
    pq_stuff: float | None
    scans: int
    points: int
    unlabelled: float
    classes: Mapping[str, ClassQuality]

    @classmethod
    def of(cls, protocol: str, scans: int, points: int, unlabelled: float, classes: dict[str, ClassQuality]) -> Quality:
        """Average the classes into a :class:`Quality`."""
        counted = [c for c in classes.values() if c.counted]
        return cls(
            protocol=protocol,
            pq=_mean(c.pq for c in counted),
            sq=_mean(c.sq for c in counted),
            rq=_mean(c.rq for c in counted),
            miou=_mean(c.iou for c in counted),
            pq_things=_mean(c.pq for c in counted if c.is_thing),
            pq_stuff=_mean(c.pq for c in counted if not c.is_thing),
            scans=scans,
            points=points,
            unlabelled=unlabelled,
            classes=classes,
        )

    @property
    def things_unscored(self) -> tuple[str, ...]:
        """Classes present in the truth whose PQ cannot be computed because the truth has no instances of them."""
        return tuple(name for name, c in self.classes.items() if c.counted and c.pq is None)

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain data for JSON, in per cent, unrounded; None where a figure cannot be computed."""
        return {
            "protocol": self.protocol,
            "pq": self.pq,
            "sq": self.sq,
            "rq": self.rq,
            "miou": self.miou,
            "pq_things": self.pq_things,
            "pq_stuff": self.pq_stuff,
            "scans": self.scans,
            "points": self.points,
            "unlabelled": self.unlabelled,
            "classes": {
                name: {
                    "pq": c.pq,
                    "sq": c.sq,
                    "rq": c.rq,
                    "iou": c.iou,
                    "tp": c.tp,
                    "fp": c.fp,
                    "fn": c.fn,
                    "truth_segments": c.truth_segments,
                    "counted": c.counted,
                }
                for name, c in self.classes.items()
            },
        }


def _mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values, or None where there is none or one of them is unknown."""
    known: list[float] = []
    for value in values:
        if value is None:
            return None
        known.append(value)
    return sum(known) / len(known) if known else None
