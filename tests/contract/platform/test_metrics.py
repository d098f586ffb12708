"""What Prometheus is told, computed from both databases and a real Redis."""

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import func, select, text, update

from l3ps_platform import workflow
from l3ps_platform.catalog import AttemptRow, Catalog, StageRow, bundles
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.metrics import LATE, CatalogCollector
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings

Found = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def scrape(catalog: Catalog, queue: Queue, jobs: int = 50) -> Found:
    return scraped(CatalogCollector(catalog, queue, jobs))


def scraped(collector: CatalogCollector) -> Found:
    registry = CollectorRegistry()
    registry.register(collector)
    text = generate_latest(registry).decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_figures_of_a_finished_job(catalog: Catalog, play, sent, tidy) -> None:
    job = play.submit(scenes=2)
    cost = workflow.Cost(2.0, 3.5, 640.0, scans=4, points=100, steps={"vote": (0.25, 50.0)})
    quality = {"protocol": "nuscenes", "primal": {"pq": 30.0, "miou": 40.0}, "refined": {"pq": 42.5, "miou": None}}
    while sent:
        play.run(lambda tx, claim: workflow.complete(tx, claim, cost, quality=quality))
    found = scrape(catalog, tidy.queue)
    refine = (("stage", "refine"),)
    per_project = (("project", "prj_default"), *refine)
    assert found["l3ps_scans_total", per_project] == 8
    assert found["l3ps_points_total", per_project] == 200
    assert found["l3ps_scenes_total", (("project", "prj_default"),)] == 2
    assert found["l3ps_bytes_total", (("project", "prj_default"), ("stage", "ingest"))] == 18
    assert found["l3ps_stage_seconds_sum", refine] == 4.0
    assert found["l3ps_stage_seconds_count", refine] == 2
    assert found["l3ps_stage_seconds_bucket", (("le", "1.0"), *refine)] == 0
    assert found["l3ps_stage_seconds_bucket", (("le", "3.0"), *refine)] == 2
    assert found["l3ps_stage_cpu_seconds_total", refine] == 7.0
    assert found["l3ps_stage_peak_megabytes", refine] == 640.0
    assert found["l3ps_step_seconds_total", (("step", "vote"),)] == 0.25 * 5 + 0.5 * 2  # and the two ingests'
    assert found["l3ps_jobs", (("project", "prj_default"), ("state", "succeeded"))] == 1
    assert found["l3ps_jobs", (("project", "prj_default"), ("state", "failed"))] == 0
    assert found["l3ps_stages", (("stage", "segment"), ("state", "done"))] == 2
    labels = (("job_id", job), ("labels", "refined"), ("protocol", "nuscenes"))
    assert found["l3ps_job_pq", labels] == 42.5
    assert ("l3ps_job_miou", labels) not in found


def test_what_came_from_the_cache_is_not_counted_as_work(catalog: Catalog, play, sent, tidy) -> None:
    play.submit(scenes=1)
    play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(0.01, scans=4, points=100, cached=True)))
    found = scrape(catalog, tidy.queue)
    assert ("l3ps_scans_total", (("project", "prj_default"), ("stage", "segment"))) not in found
    assert found["l3ps_cached_total", (("stage", "segment"),)] == 1


def test_queue_depth_and_age(catalog: Catalog, play, sent, tidy) -> None:
    play.submit(scenes=3)
    tidy.queue.send(sent)
    found = scrape(catalog, tidy.queue)
    assert found["l3ps_queue_depth", (("queue", "segment"),)] == 3
    assert found["l3ps_queue_depth", (("queue", "refine"),)] == 0
    assert found["l3ps_queue_oldest_seconds", (("queue", "segment"),)] > 0


def test_quality_is_kept_for_the_most_recent_jobs_only(catalog: Catalog, play, sent, tidy) -> None:
    ids = []
    for _ in range(3):
        ids.append(play.submit(scenes=1))
        while sent:
            quality = {"protocol": "nuscenes", "primal": {"pq": 1.0}, "refined": {"pq": 2.0}}
            play.run(lambda tx, claim, q=quality: workflow.complete(tx, claim, workflow.Cost(1.0), quality=q))
    found = {dict(labels)["job_id"] for name, labels in scrape(catalog, tidy.queue, jobs=2) if name == "l3ps_job_pq"}
    assert found == set(ids[1:])


def test_a_source_that_is_away_costs_only_its_own_series(catalog: Catalog, play, tidy) -> None:
    play.submit()
    gone = Queue(Settings(redis_url="redis://127.0.0.1:1/0"))
    found = scrape(catalog, gone)
    assert found["l3ps_source_up", (("source", "queue"),)] == 0
    assert found["l3ps_jobs", (("project", "prj_default"), ("state", "queued"))] == 1
    away = Catalog("postgresql+psycopg://nobody@127.0.0.1:1/none")
    found = scrape(away, tidy.queue)
    assert found["l3ps_source_up", (("source", "catalog"),)] == 0
    assert found["l3ps_queue_depth", (("queue", "refine"),)] == 0


RETRY = workflow.Retry(3, 0.0)
SEGMENT = ("stage", "segment")


def attempts(catalog: Catalog) -> list[tuple[int, str, str | None]]:
    with catalog.reading() as session:
        query = select(AttemptRow).where(AttemptRow.name == "segment").order_by(AttemptRow.id)
        return [(row.attempt, row.outcome, row.cause) for row in session.scalars(query)]


def test_every_attempt_is_remembered_and_counted_with_its_cause(catalog: Catalog, play, sent, tidy, cost) -> None:
    """One that ran out of disk, one whose worker was stopped, one whose worker was killed, and one that was done."""
    job = play.submit(scenes=1)
    error = {"message": "no space left", "problems": [], "cause": "disk-full"}
    play.run(lambda tx, claim: workflow.fail(tx, claim, error, retry=RETRY, cost=cost))
    tidy()
    play.run(workflow.release)
    claim = play.take(lease=-1.0)
    tidy(retry_seconds=0.0)
    tidy()
    play.run(lambda tx, claim: workflow.complete(tx, claim, cost))
    assert claim.attempt == 2
    ends = attempts(catalog)
    assert [(attempt, outcome) for attempt, outcome, _ in ends] == [
        (1, "retried"),
        (2, "released"),
        (2, "lost"),
        (3, "done"),
    ]
    assert (ends[0][2], ends[2][2]) == ("disk-full", "lease-lost")
    assert ends[1][2] is ends[3][2] is None
    with catalog.reading() as session:
        row = session.scalars(select(AttemptRow).where(AttemptRow.outcome == "lost")).one()
    assert (row.job_id, row.owner, row.project_id) == (job, "worker-1", "prj_default")
    found = scrape(catalog, tidy.queue)
    assert found["l3ps_retries_total", (SEGMENT,)] == 2
    assert found["l3ps_failures_total", (("cause", "disk-full"), SEGMENT)] == 1
    assert found["l3ps_attempts_total", (("outcome", "released"), SEGMENT)] == 1
    assert found["l3ps_attempts_total", (("outcome", "failed"), SEGMENT)] == 0
    assert found["l3ps_wasted_cpu_seconds_total", (SEGMENT,)] == cost.cpu_seconds


def test_what_is_cancelled_is_no_failure(catalog: Catalog, play, sent, cost) -> None:
    job = play.submit(scenes=1)
    claim = play.take()
    with catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    with catalog.transaction() as tx:
        workflow.fail(tx, claim, {"message": "torn down", "problems": []}, retry=RETRY, cost=cost)
    assert attempts(catalog) == [(1, "cancelled", None)]


def test_counters_never_go_down_and_the_past_is_read_once(catalog: Catalog, play, sent, tidy, cost) -> None:
    """What is remembered is not read again; what a slow transaction commits late is counted all the same."""
    collector = CatalogCollector(catalog, tidy.queue)
    points = ("l3ps_points_total", (("project", "prj_default"), ("stage", "refine")))

    def finish() -> None:
        play.submit(scenes=1)
        while sent:
            play.run(lambda tx, claim: workflow.complete(tx, claim, cost))

    def age(ids: list[int], by: timedelta) -> None:
        with catalog.transaction() as tx:
            for id in ids:
                row = tx.session.get_one(AttemptRow, id)
                row.finished_at -= by

    def all_ids() -> list[int]:
        with catalog.reading() as session:
            return list(session.scalars(select(AttemptRow.id)))

    finish()
    first = all_ids()
    age(first, 2 * LATE)
    assert scraped(collector)[points] == 10
    finish()
    late = [id for id in all_ids() if id not in first]
    age(late, LATE / 2)
    assert scraped(collector)[points] == 20
    with catalog.transaction() as tx:  # nothing of the service does this: it shows that the past is not summed again
        tx.session.execute(update(AttemptRow).where(AttemptRow.id.in_(first)).values(points=0))
    assert scraped(collector)[points] == 20
    assert scrape(catalog, tidy.queue)[points] == 10, "and a new process does sum it"


def test_scrapes_at_the_same_time_remember_the_past_once(catalog: Catalog, play, sent, tidy, cost) -> None:
    play.submit(scenes=1)
    while sent:
        play.run(lambda tx, claim: workflow.complete(tx, claim, cost))
    with catalog.transaction() as tx:
        for row in tx.session.scalars(select(AttemptRow)):
            row.finished_at -= 2 * LATE
    collector, barrier = CatalogCollector(catalog, tidy.queue), threading.Barrier(4)

    def scrape_with_others(_: int) -> Found:
        barrier.wait()
        return scraped(collector)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(scrape_with_others, range(4)))
    assert scraped(collector)["l3ps_points_total", (("project", "prj_default"), ("stage", "refine"))] == 10


def test_the_quality_of_a_model_is_that_of_its_latest_job(catalog: Catalog, play, sent, tidy, cost) -> None:
    drive, model = play.drive(scenes=1), play.model()

    def side(pq: float) -> dict:
        of_class = {"pq": pq, "sq": 80.0, "rq": 50.0, "iou": 60.0, "counted": True}
        absent = {"pq": None, "sq": None, "rq": None, "iou": 0.0, "counted": False}
        return {"pq": pq, "sq": 80.0, "rq": 50.0, "miou": 60.0, "classes": {"car": of_class, "bus": absent}}

    for primal, refined in ((30.0, 50.0), (31.0, 29.0)):
        with catalog.transaction() as tx:
            workflow.submit_job(tx, drive_id=drive, model=model)
        while sent:
            quality = {"protocol": "nuscenes", "primal": side(primal), "refined": side(refined)}
            told = {"quality": quality, "estimates": {"estimate": 0.6, "support": 0.9, "scans": 2.0}}
            play.run(lambda tx, claim, told=told: workflow.complete(tx, claim, cost, **told))
    found = scrape(catalog, tidy.queue)
    with catalog.reading() as session:
        name = bundles.get(session, model).name
    of_model = {"project": "prj_default", "model": name, "protocol": "nuscenes"}

    def value(metric: str, **labels: str) -> float | None:
        return found.get((metric, tuple(sorted((of_model | labels).items()))))

    assert value("l3ps_model_pq", labels="refined") == 29.0
    assert value("l3ps_model_pq", labels="primal") == 31.0
    assert value("l3ps_class_iou", labels="refined", **{"class": "car"}) == 60.0
    assert value("l3ps_class_iou", labels="refined", **{"class": "bus"}) is None
    estimate = (("figure", "estimate"), ("model", name), ("project", "prj_default"))
    assert found["l3ps_label_estimate", estimate] == 0.6


def test_leases_that_ran_out_and_open_uploads_show(catalog: Catalog, play, sent, tidy) -> None:
    play.submit(scenes=1)
    play.take(lease=-1.0)
    found = scrape(catalog, tidy.queue)
    assert found["l3ps_leases_expired", ()] == 1
    assert found["l3ps_uploads", (("state", "open"),)] == 0
    assert found["l3ps_stages", (SEGMENT, ("state", "running"))] == 1


def test_others_add_their_own_metrics(catalog: Catalog, tidy) -> None:
    collector = CatalogCollector(catalog, tidy.queue)

    def stages(session) -> list[GaugeMetricFamily]:
        count = session.scalar(select(func.count()).select_from(StageRow))
        return [GaugeMetricFamily("l3ps_webhooks", "How many there are.", value=count)]

    collector.add(stages)
    assert scraped(collector)["l3ps_webhooks", ()] == 0


def test_counters_begin_where_they_stood_before_attempts_were_kept(empty_url: str, tidy) -> None:
    """Stages and qualities of an older catalog are remembered by the migration."""
    upgrade(empty_url, "0005")
    catalog = Catalog(empty_url)
    when = "'2026-01-01 00:00:00+00:00'"
    quality = '{"protocol": "nuscenes", "primal": {"pq": 30.0}, "refined": {"pq": 40.0}}'
    owned = "INSERT INTO {} (id, project_id, name, filename, size, state, created_at) VALUES ('{}', 'prj_default', "
    with catalog.transaction() as tx:
        for table, id in (("drives", "drv_1"), ("models", "mdl_1")):
            tx.session.execute(text(owned.format(table, id) + f"'{id}', 'f.zip', 9, 'ready', {when})"))
        for id, pq in (("job_1", "39.0"), ("job_2", "40.0")):
            tx.session.execute(
                text(
                    "INSERT INTO jobs (id, project_id, drive_id, model_id, settings, state, cancel_requested, quality, "
                    f"created_at, finished_at) VALUES ('{id}', 'prj_default', 'drv_1', 'mdl_1', '{{}}', 'succeeded', "
                    f"false, :quality, {when}, {when})"
                ),
                {"quality": quality.replace("40.0", pq)},
            )
        for number, state in enumerate(("done", "failed", "queued")):
            tx.session.execute(
                text(
                    "INSERT INTO stages (id, job_id, name, queue, state, attempt, progress_done, progress_total, "
                    "fraction, cached, seconds, points, started_at, finished_at) VALUES "
                    f"('stg_{number}', 'job_1', 'refine', 'refine', '{state}', 1, 0, 0, "
                    f"0, false, 2.5, 10, {when}, {when})"
                )
            )
    upgrade(empty_url)
    found = scrape(catalog, tidy.queue)
    per_stage = (("project", "prj_default"), ("stage", "refine"))
    assert found["l3ps_points_total", per_stage] == 10
    assert found["l3ps_attempts_total", (("outcome", "failed"), ("stage", "refine"))] == 1
    labels = (("labels", "refined"), ("model", "mdl_1"), ("project", "prj_default"), ("protocol", "nuscenes"))
    assert found["l3ps_model_pq", labels] == 40.0, "the latest job's"
    catalog.dispose()
