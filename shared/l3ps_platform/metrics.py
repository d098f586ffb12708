"""Metrics, computed from the catalog when Prometheus asks.

Workers fork, come and go, so counters in their memory would undercount and their files would leak; the rows are
complete. Counters sum the attempts that have ended. Those of long ago are summed once and remembered; each scrape adds
the latest (:class:`History`). A process that starts again counts the same rows and comes to the same sums.

Series stay few: quality carries the job's id for the most recent jobs only, and is per model for the models used last.

Who has more to tell adds a source: ``collector.add(source)`` with a function from a session to metrics.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, TypeVar

import structlog
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from l3ps_platform.catalog import (
    Catalog,
    JobRow,
    JobState,
    Outcome,
    QueueName,
    StageName,
    StageState,
    TrainingRow,
    figures,
)
from l3ps_platform.errors import PlatformError
from l3ps_platform.quality_metrics import estimates, job_quality, model_quality
from l3ps_platform.workflow.causes import Cause

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from l3ps_platform.queue import Queue
    from l3ps_platform.settings import Settings

log = structlog.get_logger(__name__)

Source = Callable[["Session"], Iterable[Metric]]

Sums = tuple[dict[figures.Kind, figures.Tally], dict[str, tuple[int, float]]]
"""Of attempts by kind, and of steps by name: how often, and seconds."""

LATE = timedelta(minutes=5)
"""How long after its clock was read a transaction may still commit. Ours take milliseconds; one that waits for a row
that another process holds takes seconds."""


class History:
    """Sums over all attempts that ever ended: remembered for what is older than :data:`LATE`, asked for the rest."""

    def __init__(self) -> None:
        self._until: datetime | None = None
        self._attempts: dict[figures.Kind, figures.Tally] = {}
        self._steps: dict[str, tuple[int, float]] = {}
        self._lock = threading.Lock()  # two scrapes at once would remember the same span twice

    def read(self, session: Session, now: datetime) -> Sums:
        """The sums, of attempts by kind and of steps by name."""
        with self._lock:
            return self._read(session, now)

    def _read(self, session: Session, now: datetime) -> Sums:
        if self._until is None or self._until < now - 2 * LATE:
            settled = now - LATE
            past = figures.tallies(session, self._until, settled), figures.step_tallies(session, self._until, settled)
            self._attempts, self._steps = _added(self._attempts, past[0]), _stepped(self._steps, past[1])
            self._until = settled
        latest = figures.tallies(session, self._until, None), figures.step_tallies(session, self._until, None)
        return _added(self._attempts, latest[0]), _stepped(self._steps, latest[1])


class CatalogCollector(Collector):
    """Register it with ``registry.register(CatalogCollector(catalog, queue, settings.metrics_jobs))``.

    Args:
        catalog: the catalog.
        queue: for its depth.
        jobs: for how many of the most recent jobs to give the quality.
        models: for how many figures of the most recently used models to give the quality.
    """

    def __init__(self, catalog: Catalog, queue: Queue, jobs: int = 50, models: int = 20) -> None:
        self._catalog = catalog
        self._queue = queue
        self._jobs = jobs
        self._models = models
        self._history = History()
        self._sources: list[Source] = []

    def add(self, source: Source) -> None:
        """Have a source asked at every scrape, in the same session as the rest."""
        self._sources.append(source)

    def describe(self) -> list[Metric]:
        """Nothing: registering must not need a database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """All metrics; a source that is away costs its own series and is named in ``l3ps_source_up``."""
        up = GaugeMetricFamily("l3ps_source_up", "Whether the source of these metrics answers.", labels=["source"])
        try:
            with self._catalog.reading() as session:
                metrics = self._of_catalog(session)
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

    def _of_catalog(self, session: Session) -> list[Metric]:
        now = self._catalog.now(session)
        attempts, steps = self._history.read(session, now)
        by_model = figures.model_figures(session, self._models)
        return [
            *_work(attempts),
            *_ends(attempts),
            *_steps(steps),
            *_states(session, attempts),
            *_queues(session, now),
            *job_quality(figures.recent_quality(session, self._jobs)),
            *model_quality(by_model),
            *estimates(by_model),
            *(metric for source in self._sources for metric in source(session)),
        ]


class DiskCollector(Collector):
    """How much room is left where the embedded stack keeps everything; elsewhere the API has no disk of its own.

    Args:
        settings: where that is.
    """

    def __init__(self, settings: Settings) -> None:
        self._folder = settings.data_dir if settings.store_url.startswith("file://") else None

    def collect(self) -> Iterator[Metric]:
        """Nothing where there is no such folder."""
        if self._folder is None or not self._folder.is_dir():
            return
        usage = shutil.disk_usage(self._folder)
        for name, value in (("free", usage.free), ("size", usage.total)):
            yield GaugeMetricFamily(f"l3ps_disk_{name}_bytes", f"{name.title()} of the data's disk.", value=value)


def _added(
    sums: dict[figures.Kind, figures.Tally], more: dict[figures.Kind, figures.Tally]
) -> dict[figures.Kind, figures.Tally]:
    return sums | {kind: sums.get(kind, figures.Tally()) + tally for kind, tally in more.items()}


def _stepped(sums: dict[str, tuple[int, float]], more: dict[str, tuple[int, float]]) -> dict[str, tuple[int, float]]:
    before = {name: sums.get(name, (0, 0.0)) for name in more}
    return sums | {name: (before[name][0] + count, before[name][1] + total) for name, (count, total) in more.items()}


Labels = TypeVar("Labels", bound=tuple[str, ...])


def _grouped(
    attempts: dict[figures.Kind, figures.Tally], key: Callable[[figures.Kind], Labels | None]
) -> dict[Labels, figures.Tally]:
    """The tallies added up by label values; those without any are left out."""
    found: dict[Labels, figures.Tally] = {}
    for kind, tally in attempts.items():
        labels = key(kind)
        if labels is not None:
            found[labels] = found.get(labels, figures.Tally()) + tally
    return found


def _work(attempts: dict[figures.Kind, figures.Tally]) -> list[Metric]:
    """What was done and what it cost. What came from the cache was not computed and does not count."""
    per_project = ["project", "stage"]
    scans = CounterMetricFamily("l3ps_scans", "Scans processed, by stage.", labels=per_project)
    points = CounterMetricFamily("l3ps_points", "Points processed, by stage.", labels=per_project)
    size = CounterMetricFamily(
        "l3ps_bytes", "Bytes of archives taken in by `ingest`, and of labels stored by `refine`.", labels=per_project
    )
    scenes = CounterMetricFamily("l3ps_scenes", "Scenes labelled, those from the cache too.", labels=["project"])
    seconds = HistogramMetricFamily("l3ps_stage_seconds", "Wall seconds of finished stages.", labels=["stage"])
    cpu = CounterMetricFamily("l3ps_stage_cpu_seconds", "Processor seconds of finished stages.", labels=["stage"])
    peak = GaugeMetricFamily("l3ps_stage_peak_megabytes", "Highest peak memory of a stage so far.", labels=["stage"])
    computed = _grouped(attempts, lambda kind: (kind.project_id, kind.stage.value) if _computed(kind) else None)
    for labels, tally in computed.items():
        scans.add_metric(labels, tally.scans)
        points.add_metric(labels, tally.points)
        size.add_metric(labels, tally.bytes)
    refined = _grouped(attempts, lambda kind: (kind.project_id,) if _labelled(kind) else None)
    for project, tally in refined.items():
        scenes.add_metric(project, tally.count)
    for stage, tally in _grouped(attempts, lambda kind: (kind.stage.value,) if _computed(kind) else None).items():
        cpu.add_metric(stage, tally.cpu_seconds)
        peak.add_metric(stage, tally.peak_mb)
        buckets = [(str(bound), float(count)) for bound, count in zip(figures.BOUNDS, tally.within, strict=True)]
        seconds.add_metric(stage, [*buckets, ("+Inf", float(tally.count))], tally.seconds)
    return [scans, points, size, scenes, seconds, cpu, peak]


def _computed(kind: figures.Kind) -> bool:
    return kind.outcome is Outcome.DONE and not kind.cached


def _labelled(kind: figures.Kind) -> bool:
    return kind.outcome is Outcome.DONE and kind.stage is StageName.REFINE


def _ends(attempts: dict[figures.Kind, figures.Tally]) -> list[Metric]:
    """How attempts ended. Every stage has every outcome and cause, so that the first of one shows as an increase."""
    ended = CounterMetricFamily("l3ps_attempts", "Attempts at stages that ended.", labels=["stage", "outcome"])
    retries = CounterMetricFamily("l3ps_retries", "Attempts that another one follows.", labels=["stage"])
    failures = CounterMetricFamily("l3ps_failures", "Attempts that failed, by cause.", labels=["stage", "cause"])
    wasted = CounterMetricFamily(
        "l3ps_wasted_cpu_seconds", "Processor seconds of attempts without a result, where known.", labels=["stage"]
    )
    cached = CounterMetricFamily("l3ps_cached", "Stages whose output was there already.", labels=["stage"])
    by_outcome = _grouped(attempts, lambda kind: (kind.stage.value, kind.outcome.value))
    from_cache = _grouped(attempts, lambda kind: (kind.stage.value,) if kind.cached else None)
    for stage in StageName:
        ends = {outcome: by_outcome.get((stage.value, outcome.value), figures.Tally()) for outcome in Outcome}
        for outcome, tally in ends.items():
            ended.add_metric([stage.value, outcome.value], tally.count)
        retries.add_metric([stage.value], ends[Outcome.RETRIED].count + ends[Outcome.LOST].count)
        unused = sum(tally.cpu_seconds for outcome, tally in ends.items() if outcome is not Outcome.DONE)
        wasted.add_metric([stage.value], unused)
        cached.add_metric([stage.value], from_cache.get((stage.value,), figures.Tally()).count)
    by_cause = {(stage.value, cause.value): figures.Tally() for stage in StageName for cause in Cause}
    by_cause |= _grouped(attempts, lambda kind: (kind.stage.value, kind.cause) if kind.cause else None)
    for labels, tally in by_cause.items():
        failures.add_metric(labels, tally.count)
    return [ended, retries, failures, wasted, cached]


def _steps(steps: dict[str, tuple[int, float]]) -> list[Metric]:
    seconds = CounterMetricFamily("l3ps_step_seconds", "Wall seconds of the steps inside stages.", labels=["step"])
    runs = CounterMetricFamily("l3ps_step_runs", "How often a step inside a stage ran.", labels=["step"])
    for name, (count, total) in steps.items():
        seconds.add_metric([name], total)
        runs.add_metric([name], count)
    return [seconds, runs]


_ENDS_OF_STAGES = (Outcome.DONE, Outcome.FAILED, Outcome.CANCELLED)


def _states(session: Session, attempts: dict[figures.Kind, figures.Tally]) -> list[Metric]:
    families: list[Metric] = []
    projects = figures.projects(session)
    for name, kind in (("jobs", JobRow), ("trainings", TrainingRow)):
        family = GaugeMetricFamily(f"l3ps_{name}", f"{name.title()} by state.", labels=["project", "state"])
        counted = figures.job_states(session, kind)
        every = {(project, state): counted.get((project, state), 0) for project in projects for state in JobState}
        for (project, state), count in every.items():
            family.add_metric([project, state.value], count)
        families.append(family)
    stages = GaugeMetricFamily("l3ps_stages", "Stages by name and state.", labels=["stage", "state"])
    counts = figures.open_stages(session)
    # Those that are over are not counted again: their last attempts have been.
    for ended, tally in attempts.items():
        if ended.outcome in _ENDS_OF_STAGES:
            over = ended.stage, StageState(ended.outcome.value)
            counts[over] = counts.get(over, 0) + tally.count
    for stage in StageName:
        for stage_state in StageState:
            stages.add_metric([stage.value, stage_state.value], counts.get((stage, stage_state), 0))
    uploads = GaugeMetricFamily("l3ps_uploads", "Uploads by state.", labels=["state"])
    for upload_state, count in figures.upload_states(session).items():
        uploads.add_metric([upload_state.value], count)
    messages = GaugeMetricFamily("l3ps_webhook_deliveries", "Messages to webhooks by state.", labels=["state"])
    for delivery_state, count in figures.delivery_states(session).items():
        messages.add_metric([delivery_state.value], count)
    return [*families, stages, uploads, messages]


def _queues(session: Session, now: datetime) -> list[Metric]:
    oldest = GaugeMetricFamily(
        "l3ps_queue_oldest_seconds", "How long the longest waiting stage has been queued.", labels=["queue"]
    )
    since = figures.oldest_queued(session)
    for queue in QueueName:
        waited = (now - since[queue]).total_seconds() if queue in since else 0.0
        oldest.add_metric([queue.value], max(waited, 0.0))
    expired = GaugeMetricFamily("l3ps_leases_expired", "Running stages whose lease is over and not taken up yet.")
    expired.add_metric([], figures.expired_leases(session, now))
    return [oldest, expired]


def _depth(depth: dict[QueueName, int]) -> Metric:
    family = GaugeMetricFamily("l3ps_queue_depth", "Messages waiting in the queue.", labels=["queue"])
    for queue, count in depth.items():
        family.add_metric([queue.value], count)
    return family
