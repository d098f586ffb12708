"""How good labels are, for Prometheus: of the most recent jobs, and of the models used last, per class."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric

from l3ps_platform.catalog.attempt_rows import ESTIMATES, ModelFiguresRow

Figures = Sequence[tuple[ModelFiguresRow, str]]
"""Rows, each with the name of its model."""

_SIDES = ("primal", "refined")
_PER_JOB = {"pq": "Panoptic quality of a job's labels, per cent.", "miou": "Mean IoU of a job's labels, per cent."}
_WORDS = {"pq": "Panoptic quality", "sq": "Segmentation quality", "rq": "Recognition quality", "miou": "Mean IoU"}
_CLASS_WORDS = {"pq": "Panoptic quality", "sq": "Segmentation quality", "rq": "Recognition quality", "iou": "IoU"}


def job_quality(jobs: Sequence[tuple[str, dict[str, Any]]]) -> list[Metric]:
    """PQ and mIoU of jobs: (id, quality)."""
    labels = ["job_id", "labels", "protocol"]
    families = {name: GaugeMetricFamily(f"l3ps_job_{name}", text, labels=labels) for name, text in _PER_JOB.items()}
    for job_id, quality in jobs:
        for side in _SIDES:
            for name, family in families.items():
                _add(family, [job_id, side, str(quality.get("protocol", ""))], (quality.get(side) or {}).get(name))
    return list(families.values())


def model_quality(rows: Figures) -> list[Metric]:
    """The figures of each model's latest job under each protocol: the means, and those of the classes that count."""
    labels = ["project", "model", "protocol", "labels"]
    means = {
        name: GaugeMetricFamily(f"l3ps_model_{name}", f"{word} of the model's latest job, per cent.", labels=labels)
        for name, word in _WORDS.items()
    }
    classes = {
        name: GaugeMetricFamily(
            f"l3ps_class_{name}", f"{word} of a class in the model's latest job, per cent.", labels=[*labels, "class"]
        )
        for name, word in _CLASS_WORDS.items()
    }
    for row, model in rows:
        for side in _SIDES if row.kind != ESTIMATES else ():
            quality = row.figures.get(side) or {}
            named = [row.project_id, model, row.kind, side]
            for name, family in means.items():
                _add(family, named, quality.get(name))
            for class_name, of_class in (quality.get("classes") or {}).items():
                for name, family in classes.items() if of_class.get("counted", True) else ():
                    _add(family, [*named, class_name], of_class.get(name))
    return [*means.values(), *classes.values()]


def estimates(rows: Figures) -> list[Metric]:
    """What speaks for the labels of each model's latest job without truth, means over its scans."""
    labels = ["project", "model", "figure"]
    family = GaugeMetricFamily(
        "l3ps_label_estimate",
        "What speaks for the labels of the model's latest job without truth, 0 to 1.",
        labels=labels,
    )
    for row, model in rows:
        for name, value in row.figures.items() if row.kind == ESTIMATES else ():
            if name != "scans":
                _add(family, [row.project_id, model, name], value)
    return [family]


def _add(family: GaugeMetricFamily, labels: Sequence[str], value: object) -> None:
    if isinstance(value, int | float):
        family.add_metric(labels, float(value))
