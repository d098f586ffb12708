"""Both object stores and both catalogs, real ones."""

import secrets
import threading
from collections.abc import Callable, Iterator
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Base,
    Catalog,
    JobRow,
    ProjectRow,
    StageMessage,
    StageName,
    StageRow,
    Transaction,
    jobs,
    outputs,
)
from l3ps_platform.catalog import stages as catalog_stages
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.errors import InvalidSignature, ObjectMissing, StoreError, UploadError
from l3ps_platform.objects import OBJECTS_PATH, DirectoryStore, ObjectStore, open_store
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings


@pytest.fixture(params=["directory", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ObjectStore]:
    """An empty store; the directory's presigned URLs are answered as the API answers them."""
    if request.param == "s3":
        made = open_store(Settings(objects_url=request.getfixturevalue("s3_url")))
        made.ensure()
        yield made
        return
    directory = DirectoryStore(tmp_path / "store", "")
    directory.ensure()
    with ThreadingHTTPServer(("127.0.0.1", 0), _answering(directory)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield DirectoryStore(tmp_path / "store", f"http://127.0.0.1:{server.server_address[1]}")
        server.shutdown()
        thread.join()


def _answering(store: DirectoryStore) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                grant = self._grant()
                body = store.path_of(grant.key).read_bytes()
            except StoreError as error:
                self._reply(404 if isinstance(error, ObjectMissing) else 403)
                return
            named = {"Content-Disposition": f"attachment; filename*=UTF-8''{grant.filename}"} if grant.filename else {}
            self._reply(200, body, **named)

        def do_PUT(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            try:
                with store.receive(self._grant()) as incoming:
                    incoming.write(body)
            except (InvalidSignature, UploadError):
                self._reply(403)
                return
            self._reply(200, ETag=f'"{incoming.etag}"')

        def _grant(self):
            url = urlsplit(self.path)
            key = unquote(url.path).removeprefix(OBJECTS_PATH)
            return store.signer.verify(self.command, key, dict(parse_qsl(url.query)))

        def _reply(self, status: int, body: bytes = b"", **headers: str) -> None:
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(body))}.items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    return Handler


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database of each kind, without tables."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'catalog.db'}"
    return Settings(database_url=request.getfixturevalue("postgres_url")).catalog_url


@pytest.fixture(scope="session", params=["sqlite", "postgresql"])
def migrated_url(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A database of each kind with tables; tests share it, one after the other."""
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path_factory.mktemp('catalog') / 'catalog.db'}"
    else:
        url = Settings(database_url=request.getfixturevalue("postgres_server").get_uri()).catalog_url
    upgrade(url)
    return url


@pytest.fixture
def sent() -> list[StageMessage]:
    """The messages a catalog has sent, in order."""
    return []


@pytest.fixture
def catalog(migrated_url: str, sent: list[StageMessage]) -> Iterator[Catalog]:
    """An empty catalog of each kind, as the default project sees it, whose messages land in ``sent``."""
    made = Catalog(migrated_url, sent.extend).scoped(DEFAULT_PROJECT)
    with made.transaction() as tx:
        for table in reversed(Base.metadata.sorted_tables):
            tx.session.execute(table.delete())
        tx.session.add(ProjectRow(id=DEFAULT_PROJECT, name="default", created_at=tx.now))
    yield made
    made.dispose()


class Play:
    """Plays worker and clients against one catalog: the shortest way to a row in some state."""

    def __init__(self, catalog: Catalog, sent: list[StageMessage]) -> None:
        self.catalog = catalog
        self.sent = sent

    def submit(self, scenes: int = 2, **settings: Any) -> str:
        """A ready drive with scenes, a ready model and a job on them; its id. Its messages are in ``sent``."""
        drive_id, model_id = self.drive(scenes), self.model()
        with self.catalog.transaction() as tx:
            return workflow.submit_job(tx, drive_id=drive_id, model=model_id, **settings).id

    def drive(self, scenes: int = 2, **verdict: Any) -> str:
        """A checked drive."""
        with self.catalog.transaction() as tx:
            row = workflow.accept_drive(tx, name="drive", filename="d.zip", size=9, object_key="uploads/u/d.zip")
        info = {"scenes": [{"name": f"scene-{n}", "scans": 2, "points": 10} for n in range(scenes)]}
        verdict = {"usable": True, "problems": [], "sha256": "d" * 64, "format": "nuscenes", "info": info} | verdict
        self.run(lambda tx, claim: workflow.drive_checked(tx, claim, COST, **verdict), self.sent.pop())
        return row.id

    def model(self, **verdict: Any) -> str:
        """A checked model."""
        with self.catalog.transaction() as tx:
            name = f"model-{secrets.token_hex(4)}"
            row = workflow.accept_model(tx, name=name, filename="m.zip", size=9, object_key="uploads/u/m.zip")
        verdict = {"problems": [], "sha256": "a" * 64, "info": {}} | verdict
        self.run(lambda tx, claim: workflow.model_checked(tx, claim, COST, **verdict), self.sent.pop())
        return row.id

    def take(self, message: StageMessage | None = None, owner: str = "worker-1", lease: float = 60.0):
        """Claim the stage of a message, the next one sent by default."""
        message = message or self.sent.pop(0)
        with self.catalog.transaction() as tx:
            return workflow.claim(tx, message.stage_id, message.attempt, owner, lease_seconds=lease)

    def run(self, end: Callable[[Transaction, workflow.Claim], None], message: StageMessage | None = None) -> None:
        """Claim the stage of a message and end it."""
        claim = self.take(message)
        assert claim is not None
        with self.catalog.transaction() as tx:
            end(tx, claim)

    def finish_all(self) -> list[str]:
        """Complete stages until no message is left; what was done, in order."""
        done = []
        while self.sent:
            done.append(self.sent[0].name.value)
            self.run(complete)
        return done

    def job(self, id: str) -> JobRow:
        """The job as it is now."""
        with self.catalog.reading() as session:
            return jobs.get(session, id)

    def states(self, job_id: str) -> list[tuple[str, str]]:
        """(name, state) of a job's stages in the order they were planned."""
        with self.catalog.reading() as session:
            return [(s.name.value, s.state.value) for s in catalog_stages.of_job(session, job_id)]

    def stage(self, id: str) -> StageRow:
        """A stage as it is now."""
        with self.catalog.reading() as session:
            return catalog_stages.get(session, id)


COST = workflow.Cost(1.5, 2.5, 100.0, scans=2, points=10, steps={"vote": (0.5, 50.0)})


def complete(tx: Transaction, claim: workflow.Claim) -> None:
    workflow.complete(tx, claim, COST, output_key="out/x", quality={"of": claim.name.value})


@pytest.fixture
def play(catalog: Catalog, sent: list[StageMessage]) -> Play:
    """See :class:`Play`."""
    return Play(catalog, sent)


@pytest.fixture
def cost() -> workflow.Cost:
    """What a stage of the plays costs."""
    return COST


@pytest.fixture
def tidy(catalog: Catalog, redis_url: str, tmp_path: Path) -> Iterator[Callable[..., workflow.Report]]:
    """One round of the reconciler over the catalog and a real queue, ``tidy.sweep`` one of the sweeper over a directory
    store; settings can be given."""
    queue = Queue(Settings(redis_url=redis_url))
    store = DirectoryStore(tmp_path / "store", "http://api")
    store.ensure()

    def run(**settings: Any) -> workflow.Report:
        return workflow.Reconciler(catalog, queue, Settings(redis_url=redis_url, **settings)).run_once()

    def sweep(**settings: Any) -> dict[str, int]:
        return workflow.Sweeper(catalog, store, Settings(**settings)).run_once()

    run.sweep = sweep
    run.queue, run.store, run.settings = queue, store, Settings(redis_url=redis_url)
    yield run
    queue.close()


class House:
    """Jobs whose stages make real objects under content-addressed keys, and the sweep."""

    def __init__(self, catalog: Catalog, play, sent, store: DirectoryStore) -> None:
        self.catalog, self.play, self.sent, self.store = catalog, play, sent, store

    def job(self, content: str = "a", *, size: int = 100) -> str:
        """A finished job over one scene; equal ``content`` means equal outputs."""
        id = self.play.submit(scenes=1)
        self.finish(content, size=size)
        return id

    def finish(self, content: str, *, size: int = 100) -> None:
        while self.sent:
            claim = self.play.take()
            key = f"stages/{DEFAULT_PROJECT}/{claim.name.value}-{content}"
            if claim.name is StageName.PUBLISH:
                key = f"jobs/{claim.job_id}"
                self.store.put_bytes(f"{key}/poses.txt", b"poses")
                self.end(claim, f"{key}/manifest.json")
                continue
            self.pin(claim, key)
            self.store.put_bytes(f"{key}/part-1.bin", b"x" * size)
            self.end(claim, f"{key}/{outputs.MAIN[claim.name]}", size)

    def pin(self, claim, key: str) -> None:
        with self.catalog.transaction() as tx:
            workflow.pin_output(tx, claim, key)

    def end(self, claim, main: str, size: int = 0) -> None:
        self.store.put_bytes(main, b"{}")
        with self.catalog.transaction() as tx:
            workflow.complete(tx, claim, workflow.Cost(1.0), output_key=main)
            workflow.note_output(tx, main.rpartition("/")[0], size)

    def delete(self, *ids: str) -> None:
        with self.catalog.transaction() as tx:
            for id in ids:
                jobs.delete(tx, id)

    def age(self, row: type, id: str, **since: float) -> None:
        with self.catalog.transaction() as tx:
            found = tx.session.get_one(row, id)
            if row is JobRow:
                found.finished_at = tx.now - timedelta(**since)
            else:
                found.created_at = tx.now - timedelta(**since)

    def sweep(self, **settings) -> dict[str, int]:
        return workflow.Sweeper(self.catalog, self.store, Settings(**settings)).run_once()

    def groups(self, prefix: str = "") -> set[str]:
        return {info.key.rpartition("/")[0] for info in self.store.list(prefix)}


@pytest.fixture
def house(catalog: Catalog, play: Play, sent: list[StageMessage], tmp_path: Path) -> House:
    """See :class:`House`."""
    store = DirectoryStore(tmp_path / "store", "")
    store.ensure()
    return House(catalog, play, sent, store)
