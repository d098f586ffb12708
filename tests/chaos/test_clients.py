"""Clients that die, repeat themselves, change their mind, and receivers that answer badly."""

import threading
import time
from collections import Counter

import httpx
from chaoslib.receiver import Receiver, slowly
from chaoslib.servers import wait_until
from chaoslib.workload import CASES

from l3ps_platform.catalog import JobState, StageRow, StageState


def test_api_killed_in_upload(scenario, ends_well) -> None:
    """kill -9 of the API between two parts of an upload, with all jobs under way; the client goes on where it was."""
    service = scenario()
    service.begin()
    service.start_worker(concurrency=2)
    archive = padded(service.workload.drives[0], 6 << 20)
    upload = service.post("/v1/uploads", kind="drive", filename="big.zip", size=len(archive))
    assert len(upload["parts"]) == 2
    first = service.put(upload, upload["parts"][0], archive)
    service.at_work()
    service.kill(service.api)
    service.start_api()
    second = service.put(upload, upload["parts"][1], archive)
    drive = service.post(f"/v1/uploads/{upload['id']}/complete", parts=[first, second])["id"]
    job = service.submit(CASES[0], drive)
    ends_well(service)
    assert service.jobs[job] == CASES[0]


def padded(archive: bytes, size: int) -> bytes:
    """The archive with a comment's worth of nothing before it, which zip readers skip: two parts instead of one."""
    import io
    import random
    import zipfile

    noise = random.Random(0).randbytes(size)
    out = io.BytesIO(archive)
    with zipfile.ZipFile(out, "a", zipfile.ZIP_STORED) as target:
        target.writestr("padding.bin", noise)
    return out.getvalue()


def test_api_killed_in_events(scenario, ends_well) -> None:
    """kill -9 of the API while clients follow jobs by server-sent events; they reconnect with Last-Event-ID."""
    service = scenario()
    service.begin()
    jobs = list(service.jobs)[:3]
    seen: dict[str, list[tuple[str, str]]] = {job: [] for job in jobs}
    followers = [threading.Thread(target=follow, args=(service, job, seen[job])) for job in jobs]
    for follower in followers:
        follower.start()
    service.start_worker(concurrency=2)
    service.at_work("segment")
    wait_until(lambda: all(seen.values()), "no events came", 60)
    service.kill(service.api)
    service.start_api()
    service.wait()
    for follower in followers:
        follower.join(30)
        assert not follower.is_alive()
    for events in seen.values():
        ids = [id for id, _ in events]
        assert len(ids) == len(set(ids)), "an event came twice"
        assert "job.succeeded" in events[-1][1]
    ends_well(service)


def follow(service, job: str, events: list[tuple[str, str]]) -> None:
    """Follow a job's events to its end, as browsers do: again from the last id when the connection breaks.

    Progress and the snapshot at the beginning carry the number of the event before them; they are no events.
    """
    deadline, last = time.monotonic() + 150, ""
    while time.monotonic() < deadline:
        headers = {"Last-Event-ID": last} if last else {}
        try:
            with service.http.stream("GET", f"/v1/jobs/{job}/events", headers=headers, timeout=10) as answer:
                message: dict[str, str] = {}
                for line in answer.iter_lines():
                    name, _, value = line.partition(":")
                    message[name] = value.strip()
                    if not line and "data" in message:
                        last = message.get("id", last)
                        if message.get("event") not in ("snapshot", "progress"):
                            events.append((last, message["data"]))
                    if not line:
                        message = {}
        except httpx.TransportError:
            pass
        told = events and any(state in events[-1][1] for state in ("job.succeeded", "job.failed"))
        if told and service.job(job).state.final:
            return
        time.sleep(0.2)


def test_cancelled(scenario, ends_well) -> None:
    """Eight more jobs, cancelled while queued, while compiled code runs that reports nothing, and at the last stage."""
    faults = [
        {"stage": "refine", "fault": "native", "seconds": 30, "nth": [1]},
        {"stage": "publish", "fault": "slow", "seconds": 20, "nth": [1]},
    ]
    service = scenario(faults=faults, cancel_seconds=2.0)
    service.begin()
    victims = [service.submit(CASES[n]) for n in range(6)]
    for job in victims:
        service.post(f"/v1/jobs/{job}/cancel")
    assert all(service.job(job).state is JobState.CANCELLED for job in victims)
    service.start_worker(concurrency=2)
    for name in ("refine", "publish"):
        stage = service.at_work(name)
        began = time.monotonic()
        service.post(f"/v1/jobs/{stage.job_id}/cancel")
        wait_until(lambda id=stage.job_id: service.job(id).state is JobState.CANCELLED, "it was not cancelled", 15)
        service.note(f"seconds to cancel in {name}", round(time.monotonic() - began, 2))
        victims.append(stage.job_id)
    ends_well(service, dict.fromkeys(victims, JobState.CANCELLED))
    causes = {(stage.error or {}).get("cause") for stage in service_stages(service, victims[-2:])}
    assert "cancelled" in causes
    assert scenario.facts["seconds to cancel in refine"] < 10


def service_stages(service, jobs: list[str]) -> list[StageRow]:
    return service.stages(StageRow.job_id.in_(jobs), StageRow.state == StageState.CANCELLED)


def test_same_post_twice(scenario, ends_well) -> None:
    """Each of 24 jobs is asked for twice at once, with one Idempotency-Key."""
    service = scenario()
    service.begin(cases=[])
    answers: dict[int, list[httpx.Response]] = {n: [] for n in range(len(CASES))}
    barrier = threading.Barrier(2)

    def ask() -> None:
        with httpx.Client(base_url=service.settings.api_url, headers=service.http.headers, timeout=30) as http:
            for n, case in enumerate(CASES):
                barrier.wait(30)
                headers = {"Idempotency-Key": f"chaos-{n}"}
                answers[n].append(http.post("/v1/jobs", json=service.request(case), headers=headers))

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    created = len(service.all_jobs())
    assert created == len(CASES)
    for n, pair in answers.items():
        made = {answer.json()["id"] for answer in pair if answer.is_success}
        assert len(made) == 1 and {answer.status_code for answer in pair} <= {202, 409}, [a.text for a in pair]
        service.jobs[made.pop()] = CASES[n]
    service.start_worker(concurrency=2)
    service.at_work()
    ends_well(service)


def test_webhook_receivers(scenario, ends_well) -> None:
    """Receivers that answer 500 at first, 410, slowly, and with a redirect to an address that is forbidden."""

    forbidden = Receiver("127.0.0.2")
    receivers = {
        "stumbling": Receiver("127.0.0.1", lambda n: (500 if n <= 3 else 200, {})),
        "gone": Receiver("127.0.0.1", lambda n: (410, {})),
        "slow": Receiver("127.0.0.1", slowly(1.0)),
        "redirecting": Receiver("127.0.0.1", lambda n: (302, {"Location": forbidden.url})),
    }
    service = scenario(webhook_retry_seconds="0,0.2,0.5,1,2")
    try:
        service.begin()
        wanted = {"events": ["job.succeeded"]}
        made = {name: service.post("/v1/webhooks", url=one.url, **wanted)["id"] for name, one in receivers.items()}
        service.start_worker(concurrency=2)
        service.at_work()
        service.wait()
        for name in ("stumbling", "slow"):
            wait_until(lambda one=receivers[name]: len(one.ids) >= len(service.jobs), f"{name}: not all came", 60)
        assert len(receivers["gone"].received) >= 1
        assert service.http.get(f"/v1/webhooks/{made['gone']}").json()["enabled"] is False
        assert not forbidden.received, "the forbidden address was reached"
        again = Counter(id for id, _ in receivers["stumbling"].received)
        assert len(again) == len({body for _, body in receivers["stumbling"].received}), "one event under two ids"
        ends_well(service)
    finally:
        for one in (forbidden, *receivers.values()):
            one.close()
