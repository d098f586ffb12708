"""Server-sent events: what a client sees who follows a job, is cut off, and comes back."""

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import httpx
import pytest

from l3ps_cli.processes import Processes
from l3ps_cli.stack import free_port
from l3ps_platform import workflow
from l3ps_platform.catalog import ProjectRow, drives

LIFE = ["job.queued", "job.running", "scene.done", "job.succeeded"]


@dataclass
class Message:
    event: str
    id: int
    data: dict


class Stream:
    """The messages of a stream, parsed as the HTML standard says, as far as it is needed here."""

    def __init__(self, response: httpx.Response) -> None:
        self.response = response
        self._lines = response.iter_lines()
        self.retry: int | None = None

    def __iter__(self) -> Iterator[Message]:
        fields: dict[str, str] = {}
        for line in self._lines:
            if line:
                name, _, value = line.partition(":")
                fields[name] = value.removeprefix(" ")
                continue
            if "retry" in fields:
                self.retry = int(fields["retry"])
            if "data" in fields:
                yield Message(fields["event"], int(fields["id"]), json.loads(fields["data"]))
            fields = {}

    def until(self, event: str) -> list[Message]:
        """Messages up to the first of a kind; progress in between left out."""
        seen = []
        for message in self:
            if message.event != "progress" or event == "progress":
                seen.append(message)
            if message.event == event:
                return seen
        raise AssertionError(f"the stream ended without {event}: {seen}")

    def rest(self) -> list[Message]:
        """What comes before the end, without progress."""
        return [message for message in self if message.event != "progress"]


@pytest.fixture
def follow(service):
    """Opens a stream of the service."""

    @contextmanager
    def opened(path: str, last: int | None = None, **params: str) -> Iterator[Stream]:
        headers = {} if last is None else {"Last-Event-ID": str(last)}
        with service.http.stream("GET", path, headers=headers, params=params) as response:
            assert response.status_code == 200, response.read()
            assert response.headers["content-type"].startswith("text/event-stream")
            assert response.headers["cache-control"] == "no-store"
            yield Stream(response)

    return opened


def kinds(messages: list[Message]) -> list[str]:
    return [message.event for message in messages]


def test_a_job_is_followed_from_a_snapshot_to_its_end(follow, played):
    job = played(scenes=1)
    with follow(f"/v1/jobs/{job.id}/events") as stream:
        (snapshot,) = stream.until("snapshot")
        assert stream.retry == 2000
        assert (snapshot.data["id"], snapshot.data["state"]) == (job.id, "queued")
        claim = job.take()
        (running,) = stream.until("job.running")
        assert running.id > snapshot.id
        assert running.data["seq"] == running.id and running.data["subject"] == job.id
        assert running.data["type"] == "job.running" and running.data["data"]["state"] == "running"
        job.report(claim, "vote", 3, 4)
        progress = next(m for m in stream if m.event == "progress" and m.data["running"][0]["step"] == "vote")
        assert progress.id >= running.id
        assert progress.data["progress"] == pytest.approx(0.25)
        (stage,) = progress.data["running"]
        assert (stage["name"], stage["scene"], stage["done"], stage["total"]) == ("segment", "scene-0", 3, 4)
        assert progress.data["stages"] == {
            "segment": {"running": 1},
            "refine": {"waiting": 1},
            "publish": {"waiting": 1},
        }
        job.complete(claim)
        job.finish()
        rest = stream.rest()
    assert kinds(rest) == LIFE[2:], "the stream ends with the job"
    assert [m.id for m in rest] == sorted(m.id for m in rest)


def test_a_stream_that_breaks_anywhere_is_resumed_without_loss_or_repetition(follow, played):
    job = played(scenes=2)
    with follow(f"/v1/jobs/{job.id}/events") as stream:
        (snapshot,) = stream.until("snapshot")
    job.finish()
    with follow(f"/v1/jobs/{job.id}/events", last=snapshot.id) as stream:
        told = stream.rest()
    assert kinds(told) == ["job.running", "scene.done", "scene.done", "job.succeeded"]
    for count in range(1, len(told)):
        with follow(f"/v1/jobs/{job.id}/events", last=told[count - 1].id) as stream:
            assert stream.rest() == told[count:]


def test_a_stream_resumed_from_a_progress_message_misses_nothing(follow, played):
    job = played()
    claim = job.take()
    with follow(f"/v1/jobs/{job.id}/events") as stream:
        last = stream.until("progress")[-1].id
    job.complete(claim)
    job.finish()
    with follow(f"/v1/jobs/{job.id}/events", last=last) as stream:
        assert kinds(stream.rest()) == ["scene.done", "job.succeeded"]


def test_a_job_that_is_over_is_shown_once_and_then_nothing_more_is_to_come(service, follow, played):
    job = played()
    job.cancel()
    path = f"/v1/jobs/{job.id}/events"
    with follow(path) as stream:
        (snapshot,) = stream.rest()
    assert (snapshot.event, snapshot.data["state"]) == ("snapshot", "cancelled")
    answer = service.http.get(path, headers={"Last-Event-ID": str(snapshot.id)})
    assert (answer.status_code, answer.content) == (204, b""), "which tells browsers to stop asking"


def test_an_id_of_another_log_is_answered_with_a_snapshot(follow, played):
    """The catalog may have been restored from a back-up."""
    job = played()
    with follow(f"/v1/jobs/{job.id}/events", last=10**15) as stream:
        assert kinds(stream.until("snapshot")) == ["snapshot"]


def test_what_cannot_be_followed_is_refused_before_the_stream_begins(service):
    service.refused(service.http.get("/v1/jobs/none/events"), 404, "unknown-job")
    for bad in ("soon", "-1", "1.5", str(1 << 63)):
        answer = service.http.get("/v1/events", headers={"Last-Event-ID": bad})
        assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "header Last-Event-ID"
    answer = service.http.get("/v1/events", params={"kinds": "job.*,jobs.ended"})
    (error,) = service.refused(answer, 422, "invalid-request")["errors"]
    assert error["where"] == "query kinds" and "'jobs.ended'" in error["what"] and "job.failed" in error["remedy"]


def test_a_project_is_followed_by_kinds_and_subject(follow, played):
    with follow("/v1/events", kinds="job.cancelled,scene.*") as chosen:
        (opening,) = chosen.until("open")
        jobs = [played(), played()]
        for job in jobs:
            job.take()
            job.cancel()
        last = played()
        last.finish()
        told = chosen.until("scene.done")
        assert {m.id > opening.id for m in told} == {True}
        mine = [m for m in told if m.data["subject"] in {job.id for job in (*jobs, last)}]
    with follow("/v1/events", last=opening.id, subject=last.id) as only:
        assert kinds(only.until("job.succeeded")) == LIFE
    assert kinds(mine) == ["scene.done"], "a job that still runs is cancelled when its worker sees it"


def test_another_project_s_events_are_not_shown(service, follow, played):
    catalog = service.catalog.scoped("prj_events")
    with service.catalog.transaction() as tx:
        if tx.session.get(ProjectRow, "prj_events") is None:
            tx.session.add(ProjectRow(id="prj_events", name="events", created_at=tx.now))
    with follow("/v1/events") as live:
        (opening,) = live.until("open")
        with catalog.transaction() as tx:
            secret = drives.add(tx, name="secret", filename="f.zip", size=9, object_key=None)
            secret.state = secret.state.READY
            workflow.notices.of_upload(tx, secret)
        job = played()
        told = live.until("job.queued")
    assert [m.data["subject"] for m in told if m.data["subject"] == secret.id] == []
    with follow("/v1/events", last=opening.id) as replayed:
        assert secret.id not in [m.data["subject"] for m in replayed.until("job.queued")]
    assert told[-1].data["subject"] == job.id


def test_many_streams_see_the_same(follow, played):
    job = played()
    with follow(f"/v1/jobs/{job.id}/events") as first:
        first.until("snapshot")
        with follow(f"/v1/jobs/{job.id}/events") as second:
            second.until("snapshot")
            job.finish()
            assert first.rest() == second.rest() != []


@pytest.mark.once
def test_streams_end_properly_when_the_process_stops(service, tmp_path):
    """They are answered to the end, not cut off: the server gives them three seconds and then breaks them."""
    port = free_port()
    env = os.environ | {
        "L3PS_DATA_DIR": str(tmp_path),
        "L3PS_PORT": str(port),
        "L3PS_REDIS_URL": service.settings.redis_url,
    }
    url = f"http://127.0.0.1:{port}"
    with Processes(tmp_path / "logs") as processes:
        process = processes.start("api", [sys.executable, "-m", "l3ps_api"], env)
        processes.wait_until(lambda: _alive(url), "the API", 60)
        with httpx.stream("GET", f"{url}/v1/events", timeout=30) as response:
            stream = Stream(response)
            stream.until("open")
            os.kill(process.pid, signal.SIGTERM)
            assert stream.rest() == []


def _alive(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").is_success
    except httpx.TransportError:
        return False
