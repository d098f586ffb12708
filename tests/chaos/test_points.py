"""Processes that die right before and right after each thing that outlives them: a commit, a put, a message.

What the other scenarios try by hand at a few moments, these do at all of them (:mod:`chaoslib.points`).
"""

import threading
import time
from collections import Counter
from collections.abc import Callable

from chaoslib.servers import wait_until
from chaoslib.workload import CASES

from l3ps_platform.catalog import DriveRow, ModelRow, UploadRow, WebhookRow


def test_points_of_workers(scenario, ends_well) -> None:
    """kill -9 of a worker's child right before and right after its n-th commit, put and message, n to 40, in every kind
    of stage, and of its main process to 3."""
    service = scenario(points={"*": 40, "main": 3}, max_attempts=100, progress_seconds=0.4)
    service.begin()
    service.note_in_flight()
    service.start_worker("w1", concurrency=2)
    service.start_worker("w2", concurrency=2)
    _keep_up(service, service.over)
    service.start_worker("w3")  # whose start sweeps the scratch of what the last of the dead left
    died = _note(service)
    ends_well(service)
    for stage, least in {"ingest": 6, "segment": 10, "refine": 24, "publish": 10, "main": 4}.items():
        assert died[stage] >= least, died
    assert scenario.facts["attempts beyond the first"] >= 50


def test_points_of_the_api(scenario, ends_well) -> None:
    """kill -9 of the API right before and right after its n-th commit and message: while it answers (n to 4), in its
    reconciler and its deliverer (n to 3). Clients try again with the key they used."""
    limits = {"requests": 4, "reconciler": 3, "deliverer": 3}
    # An upload that was begun in the store and never known to the catalog is an orphan of that age.
    swept = {"orphan_seconds": 20.0, "orphans_every_seconds": 2.0, "upload_ttl_seconds": 20}
    service = scenario(points=limits, idempotency_lease_seconds=2.0, **swept)
    service.start_api()
    clients = threading.Thread(target=service.fill)
    clients.start()
    service.keep_up(lambda: not clients.is_alive(), 400)
    assert len(service.all_jobs()) == len(service.jobs) == len(CASES), "a job was made twice, or not at all"
    made = [len(service.rows(kind)) for kind in (DriveRow, ModelRow, UploadRow, WebhookRow)]
    assert made == [6, 1, 7, 1], made
    service.note_in_flight()
    service.start_worker(concurrency=2)
    _keep_up(service, lambda: service.over() and service.heard())
    wait_until(lambda: not service.multipart_uploads(), "an upload that nobody knows stays in the store", 90)
    died = _note(service)
    ends_well(service)
    for life, least in {"requests": 7, "reconciler": 2, "deliverer": 5}.items():
        assert died[life] >= least, died


def _keep_up(service, done: Callable[[], object]) -> None:
    began = time.monotonic()
    service.keep_up(done, 600)
    service.note("seconds to the end", round(time.monotonic() - began, 1))


def _note(service) -> Counter[str]:
    points = service.points()
    died = Counter(point.partition(".")[0] for point in points)
    service.note("deaths", dict(died))
    (service.folder / "points.txt").write_text("\n".join(points))
    return died
