"""Workers that die, stop, run out of memory, take too long, and messages that come twice."""

import os
import signal

from chaoslib.servers import wait_until

from l3ps_platform.catalog import JobState, StageRow, StageState


def test_worker_child_killed(scenario, ends_well) -> None:
    """kill -9 of a worker child in mid-stage, three times: in a segment, a refine and an ingest stage."""
    service = scenario()
    service.begin()
    service.start_worker(concurrency=2)
    for name in ("ingest", "segment", "refine"):
        os.kill(service.child_of(service.at_work(name)), signal.SIGKILL)
    ends_well(service)
    assert scenario.facts["attempts beyond the first"] >= 3


def test_worker_killed(scenario, ends_well) -> None:
    """kill -9 of a whole worker in mid-stage; the other goes on, a new one joins."""
    service = scenario(faults=[{"stage": "segment", "fault": "slow", "seconds": 0.5, "nth": [1, 2, 3]}])
    service.begin()
    first = service.start_worker("w1")
    service.start_worker("w2")
    stage = service.at_work("segment", first)
    service.kill(first)
    wait_until(lambda: not os.path.exists(f"/proc/{service.child_of(stage)}"), "its child lived on")
    service.start_worker("w3")
    ends_well(service)


def test_out_of_memory(scenario, ends_well) -> None:
    """A real MemoryError in an ingest, a segment, two refine stages and a publish stage."""
    faults = [{"stage": name, "fault": "memory", "nth": [2]} for name in ("ingest", "segment", "publish")]
    more = {"stage": "refine", "fault": "memory", "nth": [3, 4]}
    service = scenario(faults=[*faults, more], lease_seconds=10.0)  # what is told of comes before the lease runs out
    service.begin()
    worker = service.start_worker(concurrency=2)
    service.at_work()
    service.wait()
    assert worker.running(), "the worker itself was taken down"
    ends_well(service)
    assert scenario.facts["failures counted"] == 5


def test_native_abort(scenario, ends_well) -> None:
    """SIGABRT from compiled code in a segment, a refine and a publish stage."""
    faults = [{"stage": name, "fault": "abort", "nth": [2]} for name in ("segment", "refine", "publish")]
    service = scenario(faults=faults, lease_seconds=10.0)
    service.begin()
    service.start_worker(concurrency=2)
    service.at_work()
    ends_well(service)
    assert scenario.facts["failures counted"] == 3


def test_scale_in(scenario, ends_well) -> None:
    """SIGTERM to one of two workers in mid-stage: it gives its stage back, and no attempt is used up."""
    service = scenario(faults=[{"stage": "segment", "fault": "slow", "seconds": 1.0, "nth": [1, 2, 3]}])
    service.begin()
    leaving, _ = service.start_worker("w1"), service.start_worker("w2")
    service.at_work("segment", leaving)
    os.kill(leaving.pid, signal.SIGTERM)
    assert service.left(leaving) == 0
    ends_well(service)
    assert scenario.facts["attempts beyond the first"] == 0


def test_outlives_visibility_timeout(scenario, ends_well) -> None:
    """Stages of 3 s under a visibility timeout of 1 s, two workers: redelivered messages start nothing."""
    faults = [{"stage": "refine", "fault": "slow", "seconds": 3.0, "nth": [1, 5]}]
    service = scenario(visibility_seconds=1, faults=faults)
    service.begin()
    service.start_worker("w1")
    service.start_worker("w2")
    service.at_work("refine")
    ends_well(service)
    _each_ran_once(service)


def test_delivered_twice(scenario, ends_well) -> None:
    """Every message sent twice at once, again while its stage runs, and again after all is over."""
    service = scenario()
    service.begin()
    service.queue.send(service.messages(StageRow.state == StageState.QUEUED))
    service.start_worker("w1")
    service.start_worker("w2")
    for name in ("ingest", "segment", "refine"):
        service.at_work(name)
        service.queue.send(service.messages(StageRow.state.in_([StageState.QUEUED, StageState.RUNNING])))
    service.wait()
    service.queue.send(service.messages())
    ends_well(service)
    _each_ran_once(service)


def test_poison_scene(scenario, ends_well, baseline) -> None:
    """A scene that kills every process that touches it: it fails with its reason, everything else succeeds.

    The job is then run again without the poison.
    """
    # The main process notes within six seconds that a child is gone, and how; a shorter lease would say it first.
    service = scenario(faults=[{"stage": "refine", "fault": "abort", "scene": "scene-0002"}], lease_seconds=10.0)
    service.begin()
    long_drive = service.upload(service.workload.long_drive, "long.zip", "drive")
    case = next(iter(service.jobs.values()))
    poisoned = service.post("/v1/jobs", **service.request(case, long_drive))["id"]
    service.start_worker(concurrency=2)
    service.at_work()
    service.wait()
    row = service.job(poisoned)
    assert row.state is JobState.FAILED
    assert "1 of 3 scenes failed" in row.error["message"] and "SIGABRT" in row.error["message"]
    poison = next(stage for stage in service.stages(StageRow.state == StageState.FAILED))
    assert (poison.attempt, poison.failures, poison.error["cause"]) == (3, 3, "crashed")
    (service.folder / "sabotage" / "disarmed").touch()
    done = {stage.id for stage in service.stages(StageRow.job_id == poisoned, StageRow.state == StageState.DONE)}
    before = len(service.runs())
    service.post(f"/v1/jobs/{poisoned}/retry")
    ends_well(service)
    again = {stage for stage, _ in service.runs()[before:]}
    assert len(again) == 2 and poison.id in again and len(again & done) == 1  # the scene, and publishing once more


def _each_ran_once(service) -> None:
    runs = service.runs()
    assert len(runs) == len(set(runs)) == len(service.stages()), "a stage ran more than once"
