"""What must hold after every scenario, whatever happened in it."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from sqlalchemy import or_

from chaoslib import belongings, told
from chaoslib.servers import wait_until
from chaoslib.stack import Service
from chaoslib.workload import Case
from l3ps_platform.catalog import JobState, SceneRow, StageName, StageRow, StageState

Labels = dict[str, str]
"""sha256 of every label file by its path."""


def labels(service: Service, job: str) -> Labels:
    """Digests of a job's files as they lie in the store; what its manifest says of them must be true."""
    manifest = json.loads(service.store.get_bytes(f"jobs/{job}/manifest.json"))
    found = {}
    for file in manifest["files"]:
        content = service.store.get_bytes(file["key"])
        found[file["path"]] = hashlib.sha256(content).hexdigest()
        assert (found[file["path"]], len(content)) == (file["sha256"], file["size"]), file["path"]
    return found


def check(service: Service, baseline: Mapping[Case, Labels], expected: Mapping[str, JobState] = {}) -> None:
    """Every job has ended as expected, once, with the labels of an undisturbed run, and nothing is left over.

    Args:
        service: with its workers still running.
        baseline: labels of the undisturbed run.
        expected: the jobs that do not succeed.
    """
    states = service.states()
    deleted = {job.id for job in service.all_jobs() if job.deleted_at is not None}
    for job, case in service.jobs.items():
        assert states[job] is expected.get(job, JobState.SUCCEEDED), (job, str(case), service.job(job).error)
        if states[job] is JobState.SUCCEEDED and job not in deleted:
            assert labels(service, job) == baseline[case], f"{job}: other labels than undisturbed: {case}"
    _done_once(service, states, deleted)
    _scenes_agree(service, states)
    _nothing_held(service)
    told.check(service)
    belongings.check(service)
    stages = service.stages()
    service.note("jobs", len(states))
    service.note("jobs by state", dict(Counter(state.value for state in states.values())))
    service.note("attempts beyond the first", sum(stage.attempt - 1 for stage in stages))
    service.note("failures counted", sum(stage.failures for stage in stages))
    seconds: Counter[str] = Counter()
    for stage in stages:
        seconds[stage.name.value] += stage.cpu_seconds or 0.0
    service.note("processor seconds by stage", {name: round(spent, 1) for name, spent in seconds.items()})


def gone(service: Service) -> None:
    """After the service has stopped: no process of it lives, and no work of a stage lies in the scratch."""
    marker = f"L3PS_DATA_DIR={service.settings.data_dir}".encode()
    alive = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if marker in (process / "environ").read_bytes().split(b"\0"):
                alive.append((process.name, (process / "cmdline").read_bytes()[:200]))
        except (OSError, ProcessLookupError):
            continue
    assert not alive, f"processes left: {alive}"
    scratch = service.settings.scratch
    assert not list((scratch / "work").iterdir()), "work left in the scratch"
    assert not list((scratch / "locks").glob("work-*")), "locks of work left in the scratch"
    half = [entry.name for entry in (scratch / "cache").iterdir() if not (entry / "log").exists()]
    assert not half, f"half-made entries in the scratch: {half}"


def _done_once(service: Service, states: Mapping[str, JobState], deleted: set[str]) -> None:
    stages = service.stages(StageRow.job_id.is_not(None))
    planned = Counter((stage.job_id, stage.scene_id, stage.name) for stage in stages)
    assert set(planned.values()) <= {1}, "a stage was planned twice"
    for stage in stages:
        if states[stage.job_id or ""] is JobState.SUCCEEDED:
            assert stage.state is StageState.DONE, (stage.id, stage.state, stage.error)
    manifests = {job for job in states if service.store.exists(f"jobs/{job}/manifest.json")}
    published = {stage.job_id for stage in stages if stage.name is StageName.PUBLISH and stage.state is StageState.DONE}
    published -= deleted
    assert manifests == published, f"manifests of {manifests - published}, none of {published - manifests}"


def _scenes_agree(service: Service, states: Mapping[str, JobState]) -> None:
    """A scene is done if and only if each of its stages is, and none goes on when its job is over."""
    stages: dict[str, set[StageState]] = {}
    for stage in service.stages(StageRow.scene_id.is_not(None)):
        stages.setdefault(stage.scene_id or "", set()).add(stage.state)
    for scene in service.rows(SceneRow):
        found = (scene.id, scene.state, stages[scene.id], states[scene.job_id])
        assert scene.state.final, found
        assert (scene.state is StageState.DONE) == (stages[scene.id] == {StageState.DONE}), found
        assert (scene.state is StageState.FAILED) == (StageState.FAILED in stages[scene.id]), found
        if states[scene.job_id] is JobState.SUCCEEDED:
            assert scene.state is StageState.DONE, found


def _nothing_held(service: Service) -> None:
    held = service.stages(
        or_(StageRow.lease_owner.is_not(None), StageRow.lease_until.is_not(None), StageRow.state == StageState.RUNNING)
    )
    assert not held, f"stages held or running: {[(stage.id, stage.state) for stage in held]}"
    # Workers acknowledge a message after its row is written, and drop the copies that were sent meanwhile.
    wait_until(lambda: not service.messages_left(), f"messages left: {service.messages_left()}", 20)
