"""What Prometheus is told, computed from both databases and a real Redis."""

from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog
from l3ps_platform.metrics import CatalogCollector
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings


def scrape(catalog: Catalog, queue: Queue, jobs: int = 50) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    from prometheus_client import generate_latest

    registry = CollectorRegistry()
    registry.register(CatalogCollector(catalog, queue, jobs))
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
    assert found["l3ps_scans_total", refine] == 8
    assert found["l3ps_points_total", refine] == 200
    assert found["l3ps_stage_seconds_sum", refine] == 4.0
    assert found["l3ps_stage_seconds_count", refine] == 2
    assert found["l3ps_stage_seconds_bucket", (("le", "1.0"), *refine)] == 0
    assert found["l3ps_stage_seconds_bucket", (("le", "3.0"), *refine)] == 2
    assert found["l3ps_stage_cpu_seconds_total", refine] == 7.0
    assert found["l3ps_stage_peak_megabytes", refine] == 640.0
    assert found["l3ps_step_seconds_total", (("step", "vote"),)] == 0.25 * 5 + 0.5 * 2  # and the two ingests'
    assert found["l3ps_jobs", (("state", "succeeded"),)] == 1
    assert found["l3ps_jobs", (("state", "failed"),)] == 0
    assert found["l3ps_stages", (("stage", "segment"), ("state", "done"))] == 2
    labels = (("job_id", job), ("labels", "refined"), ("protocol", "nuscenes"))
    assert found["l3ps_job_pq", labels] == 42.5
    assert ("l3ps_job_miou", labels) not in found


def test_what_came_from_the_cache_is_not_counted_as_work(catalog: Catalog, play, sent, tidy) -> None:
    play.submit(scenes=1)
    play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(0.01, scans=4, points=100, cached=True)))
    assert ("l3ps_scans_total", (("stage", "segment"),)) not in scrape(catalog, tidy.queue)


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
    assert found["l3ps_jobs", (("state", "queued"),)] == 1
    away = Catalog("postgresql+psycopg://nobody@127.0.0.1:1/none")
    found = scrape(away, tidy.queue)
    assert found["l3ps_source_up", (("source", "catalog"),)] == 0
    assert found["l3ps_queue_depth", (("queue", "refine"),)] == 0
