"""Metrics, computed from the catalog when Prometheus asks.

Workers fork, come and go, so counters in their memory would undercount and their files would leak; the rows are
complete. Quality series carry the job's id and are kept for the most recent jobs only, so that their number
stays bounded.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import structlog
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from l3ps_platform.catalog import Catalog, JobRow, QueueName, figures
from l3ps_platform.errors import PlatformError

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from l3ps_platform.queue import Queue

log = structlog.get_logger(__name__)

# A scene of 40 keyframes refines in seconds to minutes; a drive is checked in less than a second.
BOUNDS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)


class CatalogCollector(Collector):
    """Register it with ``REGISTRY.register(CatalogCollector(catalog, queue, settings.metrics_jobs))``.

    Args:
        catalog: the catalog.
        queue: for its depth.
        jobs: for how many of the most recent jobs to give the quality.
    """

    def __init__(self, catalog: Catalog, queue: Queue, jobs: int = 50) -> None:
        self._catalog = catalog
        self._queue = queue
        self._jobs = jobs

    def describe(self) -> list[Metric]:
        """Nothing: registering must not need a database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """All metrics; a source that is away costs its own series and is named in ``l3ps_source_up``."""
        up = GaugeMetricFamily("l3ps_source_up", "Whether the source of these metrics answers.", labels=["source"])
        try:
            with self._catalog.reading() as session:
                metrics = [
                    *_stages(session),
                    *_states(session),
                    _oldest(session, self._catalog),
                    *_quality(figures.recent_quality(session, self._jobs)),
                ]
            yield from metrics
            up.add_metric(["catalog"], 1)
        except PlatformError as error:
            log.warning("no metrics from the catalog", reason=str(error))
            up.add_metric(["catalog"], 0)
        try:
            yield _depth(self._queue.depth())
            up.add_metric(["queue"], 1)
        except PlatformError as error:
            log.warning("no metrics from the queue", reason=str(error))
            up.add_metric(["queue"], 0)
        yield up


def _stages(session: Session) -> list[Metric]:
    scans = CounterMetricFamily("l3ps_scans", "Scans processed, by stage.", labels=["stage"])
    points = CounterMetricFamily("l3ps_points", "Points processed, by stage.", labels=["stage"])
    seconds = HistogramMetricFamily("l3ps_stage_seconds", "Wall seconds of finished stages.", labels=["stage"])
    cpu = CounterMetricFamily("l3ps_stage_cpu_seconds", "Processor seconds of finished stages.", labels=["stage"])
    peak = GaugeMetricFamily("l3ps_stage_peak_megabytes", "Highest peak memory of a stage so far.", labels=["stage"])
    for name, sums in figures.stage_figures(session, BOUNDS).items():
        label = [name.value]
        scans.add_metric(label, sums.scans)
        points.add_metric(label, sums.points)
        cpu.add_metric(label, sums.cpu_seconds)
        peak.add_metric(label, sums.peak_mb)
        buckets = [(str(bound), float(count)) for bound, count in zip(BOUNDS, sums.within, strict=True)]
        seconds.add_metric(label, [*buckets, ("+Inf", float(sums.count))], sums.seconds)
    step = CounterMetricFamily("l3ps_step_seconds", "Wall seconds of the steps inside stages.", labels=["step"])
    runs = CounterMetricFamily("l3ps_step_runs", "How often a step inside a stage ran.", labels=["step"])
    for step_name, (count, total) in figures.step_seconds(session).items():
        step.add_metric([step_name], total)
        runs.add_metric([step_name], count)
    return [scans, points, seconds, cpu, peak, step, runs]


def _states(session: Session) -> list[Metric]:
    jobs = GaugeMetricFamily("l3ps_jobs", "Jobs by state.", labels=["state"])
    for state, count in figures.job_states(session).items():
        jobs.add_metric([state.value], count)
    trainings = GaugeMetricFamily("l3ps_trainings", "Trainings by state.", labels=["state"])
    for state, count in figures.training_states(session).items():
        trainings.add_metric([state.value], count)
    stages = GaugeMetricFamily("l3ps_stages", "Stages by name and state.", labels=["stage", "state"])
    for (name, stage_state), count in figures.stage_states(session).items():
        stages.add_metric([name.value, stage_state.value], count)
    return [jobs, trainings, stages]


def _oldest(session: Session, catalog: Catalog) -> Metric:
    family = GaugeMetricFamily(
        "l3ps_queue_oldest_seconds", "How long the longest waiting stage has been queued.", labels=["queue"]
    )
    now, since = catalog.now(session), figures.oldest_queued(session)
    for queue in QueueName:
        waited = (now - since[queue]).total_seconds() if queue in since else 0.0
        family.add_metric([queue.value], max(waited, 0.0))
    return family


def _depth(depth: dict[QueueName, int]) -> Metric:
    family = GaugeMetricFamily("l3ps_queue_depth", "Messages waiting in the queue.", labels=["queue"])
    for queue, count in depth.items():
        family.add_metric([queue.value], count)
    return family


def _quality(jobs: list[JobRow]) -> list[Metric]:
    labels = ["job_id", "labels", "protocol"]
    families = {
        "pq": GaugeMetricFamily("l3ps_job_pq", "Panoptic quality of a job's labels, per cent.", labels=labels),
        "miou": GaugeMetricFamily("l3ps_job_miou", "Mean IoU of a job's labels, per cent.", labels=labels),
    }
    for job in jobs:
        quality = job.quality or {}
        for kind in ("primal", "refined"):
            for figure, family in families.items():
                value = (quality.get(kind) or {}).get(figure)
                if value is not None:
                    family.add_metric([job.id, kind, str(quality.get("protocol", ""))], float(value))
    return list(families.values())
