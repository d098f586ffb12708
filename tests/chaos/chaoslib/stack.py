"""One scenario's service: API and workers as real processes, a catalog, bucket and queue of its own."""

import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
from sqlalchemy import inspect, select

from chaoslib.proxy import Proxy, Rule
from chaoslib.receiver import Answer, Receiver, taken
from chaoslib.servers import Minio, Postgres, Redis, wait_until
from chaoslib.workload import CASES, Case, Workload
from l3ps_cli.processes import Processes
from l3ps_cli.stack import QUEUES, STOP_WORKER, WORKER, free_port
from l3ps_platform.catalog import Catalog, JobRow, JobState, StageMessage, StageRow, StageState, TrainingRow
from l3ps_platform.catalog.event_rows import DeliveryRow
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.catalog.states import DeliveryState
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.processes import GENTLY, Child, StopPlan
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
    "webhook_allow": "127.0.0.1/32",
    "webhook_http": True,
    "webhook_timeout_seconds": 3.0,
    "webhook_retry_seconds": "0,0.5,1,2,4",
}
ANSWERS_WITHIN = 120.0
_AGAIN = (409, 429, 500, 502, 503, 504)
"""Answers after which clients try the same once more; 409 says that the first try is still under way."""
Row = TypeVar("Row")
FINISHES_WITHIN = 300.0
"""On two idle cores the slowest scenario takes a third of it; a busy machine is no reason to fail."""
AT_WORK_WITHIN = 120.0
HEARD_WITHIN = 60.0
"""The webhook's last message after the last job's end: what a killed API had in hand comes when its lease is over."""


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
        points: whose processes die at how many points (:mod:`chaoslib.points`); then clients try again what failed.
        witness: how the webhook that is told of everything answers.
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
        points: Mapping[str, int] | None = None,
        witness: Answer = taken,
        **settings: Any,
    ) -> None:
        self.folder, self.servers, self.workload, self.note = folder, servers, workload, note
        self.patient = points is not None
        self._undo = ExitStack()
        self.processes = self._undo.enter_context(Processes(folder / "logs"))
        (folder / "sabotage").mkdir(parents=True)
        places = self._places(rules)
        self.settings = Settings(**(QUICK | places | settings), token=TOKEN)
        given = {**QUICK, **places, **settings}
        self.env = os.environ | {f"L3PS_{name.upper()}": str(value) for name, value in given.items()}
        self.env |= {"L3PS_TOKEN": TOKEN, "L3PS_LOG_FORMAT": "console", "PYTHONUNBUFFERED": "1"}
        self.env |= {"CHAOS_FOLDER": str(folder / "sabotage"), "CHAOS_FAULTS": json.dumps(list(faults))}
        self.env["CHAOS_POINTS"] = json.dumps(dict(points or {}))
        self.env["PYTHONPATH"] = str(Path(__file__).parent.parent)
        upgrade(self.settings.catalog_url)
        self.catalog = Catalog(self.settings.catalog_url)
        self.store: ObjectStore = open_store(self._direct())
        self.queue = Queue(self.settings)
        headers = {"Authorization": f"Bearer {TOKEN}"}
        self.http = httpx.Client(base_url=self.settings.api_url, headers=headers, timeout=30, trust_env=False)
        self.jobs: dict[str, Case] = {}
        self.drives: list[str] = []
        self._again: dict[str, Callable[[], Child]] = {}
        self.witness = Receiver("127.0.0.1", witness)
        self._undo.callback(self.witness.close)

    def _places(self, rules: Sequence[Rule]) -> dict[str, Any]:
        """The settings that say where things are."""
        minio, port = self.servers.minio, None
        if rules:
            port = self._undo.enter_context(Proxy(minio.port, list(rules))).port
        self.bucket = f"chaos-{secrets.token_hex(4)}"
        return {
            "data_dir": self.folder / "data",
            "database_url": self.servers.postgres.database(),
            "redis_url": self.servers.redis.url,
            "objects_url": minio.url(self.bucket, port),
            "objects_public_url": f"http://127.0.0.1:{minio.port}",
            "port": free_port(),
        }

    def _direct(self) -> Settings:
        """The settings without the proxy."""
        return self.settings.model_copy(update={"objects_url": self.servers.minio.url(self.bucket)})

    # Processes

    def start_api(self, name: str = "api", port: int | None = None) -> Child:
        """The API, in its real program; a second one has a name and a port of its own."""
        program = "chaoslib.api" if self.patient else "l3ps_api"
        env = self.env | ({} if port is None else {"L3PS_PORT": str(port)})
        child = self._start(name, [sys.executable, "-P", "-m", program], env)
        if port is None:
            self.api = child
        url = f"http://127.0.0.1:{port or self.settings.port}/readyz"
        wait_until(lambda: self._answers(url) or not child.running(), "the API did not start", 60)
        return child

    def start_worker(self, name: str = "w1", concurrency: int = 1, queues: str = QUEUES, **env: str) -> Child:
        """The worker as ``l3ps up`` starts it, but for the faults in its stages and the traces that runs leave."""
        program = [*WORKER[:2], "chaoslib.saboteur", *WORKER[3:]]
        command = [sys.executable, "-P", "-m", *program, "-Q", queues, "-c", str(concurrency), "-n", f"{name}@%h"]
        return self._start(name, command, self.env | env, STOP_WORKER)

    def _start(self, name: str, command: list[str], env: dict[str, str], stop_plan: StopPlan = GENTLY) -> Child:
        self._again[name] = lambda: self._start(name, command, env, stop_plan)
        return self.processes.start(name, command, env, stop_plan=stop_plan)

    def keep_up(self, done: Callable[[], object], seconds: float = FINISHES_WITHIN) -> None:
        """Start again what dies, as init systems and clusters do, until something is true."""
        deadline = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < deadline, f"not done after {seconds:.0f} s: {self.processes.children}"
            for child in [child for child in self.processes.children if not child.running()]:
                self.processes.children.remove(child)
                again = self._again[child.name]()
                if child.name == "api":
                    self.api = again
            time.sleep(0.1)

    def kill(self, child: Child) -> None:
        """SIGKILL, and nothing told to anyone."""
        os.kill(child.pid, signal.SIGKILL)
        wait_until(lambda: not child.running(), "it survived SIGKILL")
        self.processes.children.remove(child)

    def stop(self, child: Child) -> None:
        """SIGTERM, and wait."""
        child.stop()
        self.processes.children.remove(child)

    def left(self, child: Child) -> int | None:
        """The status of a child that was asked to leave, once it has."""
        wait_until(lambda: not child.running(), f"{child.name} did not leave", 60)
        self.processes.children.remove(child)
        return child.returncode

    # What clients do

    def begin(self, cases: Sequence[Case] = CASES) -> None:
        """API, uploads and jobs; no worker yet, so that all jobs are in flight when the first one starts.

        A webhook is told of all that happens from here on: the witness.
        """
        self.start_api()
        self.fill(cases)

    def fill(self, cases: Sequence[Case] = CASES) -> None:
        """What clients do: the webhook, uploads and jobs."""
        self.post("/v1/webhooks", url=self.witness.url)
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
        answer = self._insist(path, headers, body) if self.patient else self.http.post(path, json=body, headers=headers)
        assert answer.is_success, f"{answer.status_code}: {answer.text}"
        return dict(answer.json())

    def put_json(self, path: str, **body: Any) -> None:
        answer = self.http.put(path, json=body)
        assert answer.is_success, f"{answer.status_code}: {answer.text}"

    def delete(self, path: str) -> bool:
        """Delete something, as often as it takes; whether it was there."""
        deadline = time.monotonic() + ANSWERS_WITHIN
        while True:
            with suppress(httpx.TransportError):
                answer = self.http.delete(path)
                if answer.status_code not in _AGAIN:
                    return answer.is_success or answer.status_code == 404  # the first try's answer may be lost
            assert time.monotonic() < deadline, f"DELETE {path}: no answer"
            time.sleep(0.1)

    def _insist(self, path: str, headers: dict[str, str] | None, body: Any) -> httpx.Response:
        """As a client does whose answer may get lost: the same again under one key, until there is an answer."""
        headers = {"Idempotency-Key": secrets.token_hex(8)} | (headers or {})
        deadline = time.monotonic() + ANSWERS_WITHIN
        while True:
            with suppress(httpx.TransportError):
                answer = self.http.post(path, json=body, headers=headers)
                if answer.status_code not in _AGAIN:
                    return answer
            assert time.monotonic() < deadline, f"POST {path}: no answer"
            time.sleep(0.1)

    def _answers(self, url: str) -> bool:
        try:
            return httpx.get(url, timeout=2, trust_env=False).is_success
        except httpx.TransportError:
            return False

    # What the catalog says

    def job(self, id: str) -> JobRow:
        with self.catalog.reading() as session:
            return session.get_one(JobRow, id)

    def rows(self, kind: type[Row], *conditions: Any) -> list[Row]:
        """Of a table, in the order of their keys."""
        with self.catalog.reading() as session:
            return list(session.scalars(select(kind).where(*conditions).order_by(*inspect(kind).primary_key)))

    def all_jobs(self) -> list[JobRow]:
        return self.rows(JobRow)

    def stages(self, *conditions: Any) -> list[StageRow]:
        return self.rows(StageRow, *conditions)

    def at_work(self, name: str | None = None, worker: Child | None = None) -> StageRow:
        """A stage that runs; of this name, in this worker. The figure of jobs in flight is noted."""
        of_name = (StageRow.name == name,) if name else ()
        of_worker = (StageRow.lease_owner.like(f"%:{worker.pid}:%"),) if worker else ()
        conditions = (StageRow.state == StageState.RUNNING, *of_name, *of_worker)

        def found() -> StageRow | None:
            return next(iter(self.stages(*conditions)), None)

        stage = wait_until(found, f"no stage {name or ''} ran", AT_WORK_WITHIN)
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

    def messages_left(self) -> dict[str, int]:
        """Messages in the queues, and delivered ones that nobody has acknowledged."""
        return self.servers.redis.left()

    def multipart_uploads(self) -> list[str]:
        """Uploads in the store that are neither joined nor aborted."""
        return self.servers.minio.multipart_uploads()

    def runs(self) -> list[tuple[str, str]]:
        """(stage, attempt) of every run that the workers began."""
        lines = (self.folder / "sabotage" / "runs.log").read_text().splitlines()
        return [(line.split()[0], line.split()[1]) for line in lines]

    def points(self) -> list[str]:
        """Where processes have died so far (:mod:`chaoslib.points`)."""
        return sorted(p.name for p in (self.folder / "sabotage" / "points").glob("*") if not p.name.startswith("of."))

    def wait(self, seconds: float = FINISHES_WITHIN) -> None:
        """Wait until every job and training is in a final state, every upload checked and the witness told of it."""
        started = time.monotonic()
        wait_until(self.over, "not every job came to an end", seconds, pause=0.3)  # it reads every row
        self.note("seconds to the end", round(time.monotonic() - started, 1))
        wait_until(self.heard, "deliveries are still under way", HEARD_WITHIN, 0.3)

    def over(self) -> bool:
        """Whether nothing is left to do but to tell of it."""
        parents = [*self.all_jobs(), *self.rows(TrainingRow)]
        return all(one.state.final for one in parents) and not self.stages(~_final())

    def heard(self) -> bool:
        """Whether every webhook has been told of everything, or has been given up."""
        return not self.rows(DeliveryRow, DeliveryRow.state == DeliveryState.PENDING)

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
