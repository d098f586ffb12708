"""One scenario's service: API and workers as real processes, a catalog, bucket and queue of its own."""

import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from chaoslib.proxy import Proxy, Rule
from chaoslib.servers import Minio, Postgres, Redis, wait_until
from chaoslib.workload import CASES, Case, Workload
from l3ps_cli.processes import Processes
from l3ps_cli.stack import QUEUES, STOP_WORKER, WORKER, free_port
from l3ps_platform.catalog import Catalog, JobRow, JobState, StageMessage, StageRow, StageState
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.processes import Child
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings

TOKEN = "chaos"
QUICK = {
    "lease_seconds": 3.0,
    "heartbeat_seconds": 0.5,
    "reconcile_seconds": 0.3,
    "retry_seconds": 0.2,
    "resend_seconds": 2.0,
    "outage_retry_seconds": 1.0,
    "progress_seconds": 0.1,
    "part_bytes": 5 << 20,
    "threads": 1,
}
FINISHES_WITHIN = 150.0


@dataclass
class Servers:
    """What all scenarios share, one after the other."""

    redis: Redis
    minio: Minio
    postgres: Postgres


class Service:
    """The running service of one scenario.

    Args:
        folder: for its data, logs and traces of sabotage.
        servers: what it stands on.
        workload: what to upload.
        note: keeps a figure for the report.
        rules: faults of the object store, if any; then the service reaches it through a proxy.
        faults: faults of the workers' stages (:mod:`chaoslib.saboteur`).
        settings: besides the quick ones.
    """

    def __init__(
        self,
        folder: Path,
        servers: Servers,
        workload: Workload,
        note: Callable[[str, object], None],
        *,
        rules: Sequence[Rule] = (),
        faults: Sequence[dict[str, Any]] = (),
        **settings: Any,
    ) -> None:
        self.folder, self.servers, self.workload, self.note = folder, servers, workload, note
        self._undo = ExitStack()
        self.processes = self._undo.enter_context(Processes(folder / "logs"))
        (folder / "sabotage").mkdir(parents=True)
        port = self._undo.enter_context(Proxy(servers.minio.port, list(rules))).port if rules else None
        self.bucket = f"chaos-{secrets.token_hex(4)}"
        places = {
            "data_dir": folder / "data",
            "database_url": servers.postgres.database(),
            "redis_url": servers.redis.url,
            "objects_url": servers.minio.url(self.bucket, port),
            "objects_public_url": f"http://127.0.0.1:{servers.minio.port}",
            "port": free_port(),
        }
        self.settings = Settings(**(QUICK | places | settings), token=TOKEN)
        given = {**QUICK, **places, **settings}
        self.env = os.environ | {f"L3PS_{name.upper()}": str(value) for name, value in given.items()}
        self.env |= {"L3PS_TOKEN": TOKEN, "L3PS_LOG_FORMAT": "console", "PYTHONUNBUFFERED": "1"}
        self.env |= {"CHAOS_FOLDER": str(folder / "sabotage"), "CHAOS_FAULTS": json.dumps(list(faults))}
        self.env["PYTHONPATH"] = str(Path(__file__).parent.parent)
        upgrade(self.settings.catalog_url)
        self.catalog = Catalog(self.settings.catalog_url)
        direct = self.settings.model_copy(update={"objects_url": servers.minio.url(self.bucket)})
        self.store: ObjectStore = open_store(direct)
        self.queue = Queue(self.settings)
        headers = {"Authorization": f"Bearer {TOKEN}"}
        self.http = httpx.Client(base_url=self.settings.api_url, headers=headers, timeout=30, trust_env=False)
        self.jobs: dict[str, Case] = {}
        self.drives: list[str] = []

    # Processes

    def start_api(self) -> Child:
        self.api = self.processes.start("api", [sys.executable, "-P", "-m", "l3ps_api"], self.env)
        wait_until(self._answers, "the API did not start", 60)
        return self.api

    def start_worker(self, name: str = "w1", concurrency: int = 1) -> Child:
        """The worker as ``l3ps up`` starts it, but for the faults in its stages and the traces that runs leave."""
        program = [*WORKER[:2], "chaoslib.saboteur", *WORKER[3:]]
        command = [sys.executable, "-P", "-m", *program, "-Q", QUEUES, "-c", str(concurrency), "-n", f"{name}@%h"]
        return self.processes.start(name, command, self.env, stop_plan=STOP_WORKER)

    def kill(self, child: Child) -> None:
        """SIGKILL, and nothing told to anyone."""
        os.kill(child.pid, signal.SIGKILL)
        wait_until(lambda: not child.running(), "it survived SIGKILL")
        self.processes.children.remove(child)

    def left(self, child: Child) -> int | None:
        """The status of a child that was asked to leave, once it has."""
        wait_until(lambda: not child.running(), f"{child.name} did not leave", 60)
        self.processes.children.remove(child)
        return child.returncode

    # What clients do

    def begin(self, cases: Sequence[Case] = CASES) -> None:
        """API, uploads and jobs; no worker yet, so that all jobs are in flight when the first one starts."""
        self.start_api()
        self.upload(self.workload.model, "m.zip", "model", name="colours")
        self.drives = [self.upload(drive, f"d{n}.zip", "drive") for n, drive in enumerate(self.workload.drives)]
        for case in cases:
            self.submit(case)

    def upload(self, data: bytes, filename: str, kind: str, **completion: Any) -> str:
        """An upload as clients make it; the id of what it became."""
        upload = self.post("/v1/uploads", kind=kind, filename=filename, size=len(data))
        parts = [self.put(upload, part, data) for part in upload["parts"]]
        return str(self.post(f"/v1/uploads/{upload['id']}/complete", parts=parts, **completion)["id"])

    @staticmethod
    def put(upload: dict[str, Any], part: dict[str, Any], data: bytes) -> dict[str, Any]:
        start = (part["number"] - 1) * upload["part_size"]
        answer = httpx.put(part["url"], content=data[start : start + upload["part_size"]], trust_env=False)
        assert answer.is_success, answer.text
        return {"number": part["number"], "etag": answer.headers["etag"]}

    def submit(self, case: Case, drive: str | None = None, **headers: str) -> str:
        job = self.post("/v1/jobs", headers=headers, **self.request(case, drive))["id"]
        self.jobs[job] = case
        return str(job)

    def request(self, case: Case, drive: str | None = None) -> dict[str, Any]:
        asked = {"drive_id": drive or self.drives[case.drive], "model": "colours", "preset": case.preset}
        return asked | {"formats": [case.format]}

    def post(self, path: str, headers: dict[str, str] | None = None, **body: Any) -> dict[str, Any]:
        answer = self.http.post(path, json=body, headers=headers)
        assert answer.is_success, f"{answer.status_code}: {answer.text}"
        return dict(answer.json())

    def _answers(self) -> bool:
        try:
            return self.http.get("/readyz", timeout=2).is_success
        except httpx.TransportError:
            return False

    # What the catalog says

    def job(self, id: str) -> JobRow:
        with self.catalog.reading() as session:
            return session.get_one(JobRow, id)

    def all_jobs(self) -> list[JobRow]:
        from sqlalchemy import select

        with self.catalog.reading() as session:
            return list(session.scalars(select(JobRow).order_by(JobRow.id)))

    def stages(self, *conditions: Any) -> list[StageRow]:
        from sqlalchemy import select

        with self.catalog.reading() as session:
            return list(session.scalars(select(StageRow).where(*conditions).order_by(StageRow.id)))

    def at_work(self, name: str | None = None, worker: Child | None = None) -> StageRow:
        """A stage that runs; of this name, in this worker. The figure of jobs in flight is noted."""
        of_name = (StageRow.name == name,) if name else ()
        of_worker = (StageRow.lease_owner.like(f"%:{worker.pid}:%"),) if worker else ()
        conditions = (StageRow.state == StageState.RUNNING, *of_name, *of_worker)

        def found() -> StageRow | None:
            return next(iter(self.stages(*conditions)), None)

        stage = wait_until(found, f"no stage {name or ''} ran", 60)
        assert isinstance(stage, StageRow)
        self.note_in_flight()
        return stage

    def note_in_flight(self) -> None:
        """Note how many jobs are in flight now, for the report."""
        self.note("in flight", sum(not job.state.final for job in self.all_jobs()))

    @staticmethod
    def child_of(stage: StageRow) -> int:
        assert stage.lease_owner is not None
        return int(stage.lease_owner.rpartition(":")[2])

    def messages(self, *conditions: Any) -> list[StageMessage]:
        return [StageMessage(s.id, s.attempt, s.name, s.queue) for s in self.stages(*conditions)]

    def runs(self) -> list[tuple[str, str]]:
        """(stage, attempt) of every run that the workers began."""
        lines = (self.folder / "sabotage" / "runs.log").read_text().splitlines()
        return [(line.split()[0], line.split()[1]) for line in lines]

    def wait(self, seconds: float = FINISHES_WITHIN) -> None:
        """Wait until every job is in a final state, and every upload checked."""
        started = time.monotonic()

        def over() -> bool:
            return all(job.state.final for job in self.all_jobs()) and not self.stages(~_final())

        wait_until(over, "not every job came to an end", seconds, pause=0.3)  # it reads every row
        self.note("seconds to the end", round(time.monotonic() - started, 1))

    def states(self) -> dict[str, JobState]:
        return {job.id: job.state for job in self.all_jobs()}

    def close(self) -> None:
        """Stop all of it."""
        self.http.close()
        self._undo.close()
        self.queue.close()
        self.catalog.dispose()


def _final() -> Any:
    return StageRow.state.in_([state for state in StageState if state.final])
