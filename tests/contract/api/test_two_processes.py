"""Two API processes on one catalog: two reconcilers, two sweepers, two deliverers, and nothing is done twice."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from sqlalchemy import func, select

from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    AttemptRow,
    Catalog,
    DeliveryRow,
    DeliveryState,
    DriveState,
    EventRow,
    JobRow,
    ModelState,
    QueueName,
    StageRow,
    StageState,
    WebhookRow,
    bundles,
    drives,
    jobs,
    rules,
    stages,
    webhooks,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.ids import new_id
from l3ps_platform.objects import DirectoryStore
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings
from l3ps_platform.webhooks.deliverer import SHARE
from l3ps_platform.workflow import Retry, deliveries

SCENES = 8
HOOKS = 5
MESSAGES = 8


class Place:
    """A catalog, a queue and a store; a receiver of webhooks; and what has to be tidied up in them."""

    def __init__(self, settings: Settings, folder: Path) -> None:
        upgrade(settings.catalog_url)
        self.catalog = Catalog(settings.catalog_url).scoped(DEFAULT_PROJECT)  # sends nothing: all messages are lost
        self.queue = Queue(settings)
        self.store = DirectoryStore(folder, "")
        self.store.ensure()
        self.received: Counter[str] = Counter()
        self.answers = threading.Event()
        place = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                self.rfile.read(int(self.headers["content-length"]))
                place.received[self.headers["webhook-id"]] += 1
                place.answers.wait()
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.05,))
        self.thread.start()
        with self.catalog.transaction() as tx:
            model = bundles.add(tx, name="model", filename="m.zip", size=9, object_key=None)
            model.state, model.info = ModelState.READY, {}
            settings_ = {"model": "model"}
            self.rule = rules.add(tx, name="rule", bucket="fleet", prefix="", suffix=None, settings=settings_)
            url = f"http://127.0.0.1:{self.server.server_port}/"
            named = {"url": url, "secret": "whsec_AAAA", "events": ["scene.done"], "enabled": True}
            hooks = [WebhookRow(id=new_id("whk"), created_at=tx.now, **named) for _ in range(HOOKS)]
            tx.session.add_all(hooks)
        self.hooks = [hook.id for hook in hooks]

    def close(self) -> None:
        self.answers.set()
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()
        self.queue.close()
        self.catalog.dispose()

    def job(self, scenes: int = SCENES, **waiting: float) -> list[StageRow]:
        """The first stages of a new job, whose messages were lost that long ago."""
        with self.catalog.transaction() as tx:
            drive = drives.add(tx, name="drive", filename="d.zip", size=9, object_key=None)
            named = [{"name": f"scene-{n}", "scans": 1, "points": 5} for n in range(scenes)]
            drive.state, drive.info = DriveState.READY, {"scenes": named, "scans": scenes, "points": 5 * scenes}
            tx.session.flush()
            job = workflow.submit_job(tx, drive_id=drive.id, model="model")
            found = [row for row in stages.of_job(tx.session, job.id) if row.state is StageState.QUEUED]
            for row in found:
                row.queued_at = tx.now - timedelta(**waiting)
        return found

    def taken(self, lease: float) -> list[workflow.Claim]:
        """The same, in a worker's hands."""
        claims = []
        for number, row in enumerate(self.job()):
            with self.catalog.transaction() as tx:
                claims.append(workflow.claim(tx, row.id, 1, f"host:1:{number}", lease_seconds=lease))
        return claims

    def deleted_job(self, name: str) -> None:
        """A job that is over and deleted, with its labels still in the store."""
        (row,) = self.job(1)
        with self.catalog.transaction() as tx:
            workflow.cancel_job(tx, row.job_id)
            self.store.put_bytes(f"jobs/{row.job_id}/{name}", b"labels")
            jobs.delete(tx, row.job_id)

    def wave(self, number: int) -> set[str]:
        """Something for everybody to do; ids of the stages that go on to a second attempt."""
        lost = {claim.stage_id for claim in self.taken(lease=-1)}
        failed = self.taken(lease=60)
        for claim in failed:
            with self.catalog.transaction() as tx:
                error = {"message": "the store was away", "problems": []}
                workflow.fail(tx, claim, error, retry=Retry(3, 0))
        self.deleted_job(f"labels-{number}")
        with self.catalog.transaction() as tx:
            for hook in sorted(self.hooks):
                for _ in range(MESSAGES):
                    deliveries.ping(tx, webhooks.lock(tx.session, hook))
            arrived = [(self.rule, f"{number}{n}" * 16, f"{number}-{n}", f"s3://fleet/{number}-{n}") for n in range(5)]
            rules.note(tx, arrived)
        return lost | {claim.stage_id for claim in failed}

    def settled(self) -> bool:
        """Whether nothing is left to do."""
        with self.catalog.reading() as session:
            waits = select(func.count()).select_from(StageRow)
            left = session.scalar(
                waits.where(StageRow.state.in_([StageState.RUNNING]) | StageRow.not_before.is_not(None))
            )
            unsent = session.scalar(select(func.count()).where(DeliveryRow.state == DeliveryState.PENDING))
            return not (left or unsent or rules.waiting(session) or jobs.unswept(session) or self._missing(session))

    def _missing(self, session) -> set[tuple[str, int]]:
        queued = select(StageRow.id, StageRow.attempt).where(StageRow.state == StageState.QUEUED)
        there = {pair for name in QueueName for pair in self.queue.pending(name)}
        return {(id, attempt) for id, attempt in session.execute(queued)} - there


@pytest.fixture
def place(postgres_url: str, redis_url: str, tmp_path: Path) -> Iterator[Place]:
    made = Place(Settings(database_url=postgres_url, redis_url=redis_url), tmp_path / "store")
    yield made
    made.close()


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_two_api_processes_do_everything_once(place, api_process, postgres_url, redis_url) -> None:
    first = {row.id for row in place.job(hours=1)}
    settings = {"database_url": postgres_url, "redis_url": redis_url, "objects_url": place.store.root.as_uri()}
    settings |= {"reconcile_seconds": "0.1", "lease_seconds": "0.5", "webhook_allow": "127.0.0.1/32"}
    for _ in range(2):
        api_process(**settings, webhook_http="1", token="operator")
    second = place.wave(1)
    until(lambda: place.received.total() >= 2 * SHARE)  # no process holds more than its share: both are at work
    place.answers.set()
    until(place.settled)
    # By the time that these are done, whatever was begun twice of the others has shown.
    second |= place.wave(2)
    until(place.settled)

    sent = [pair for name in QueueName for pair in place.queue._redis.lrange(name.value, 0, -1)]
    there = {pair for name in QueueName for pair in place.queue.pending(name)}
    assert len(sent) == len(there), "no message twice"
    with place.catalog.reading() as session:
        arrived = session.scalars(select(JobRow.id).where(JobRow.id.in_(select(rules.ArrivalRow.job_id)))).all()
        ingests = {row.id for row in session.scalars(select(StageRow).where(StageRow.name == "ingest"))}
        assert there == {(id, 1) for id in first | ingests} | {(id, 2) for id in second}
        assert len(arrived) == len(ingests) == 10, "a job and a drive for each arrival"
        ended = Counter(session.scalars(select(AttemptRow.stage_id)))
        assert {id: ended[id] for id in second} == dict.fromkeys(second, 1), "each attempt ended once"
        retried = select(func.count()).where(EventRow.kind == "stage.retried")
        assert session.scalar(retried) == len(second)
        rows = session.scalars(select(DeliveryRow)).all()
        assert {(row.state, row.attempt) for row in rows} == {(DeliveryState.DELIVERED, 1)}
    assert place.received == dict.fromkeys([row.id for row in rows], 1) and len(rows) == 2 * HOOKS * MESSAGES
    assert list(place.store.list()) == []
