"""What must hold after every scenario, whatever happened in it."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from chaoslib.servers import wait_until
from chaoslib.stack import Service
from chaoslib.workload import Case
from l3ps_platform.catalog import (
    DriveRow,
    JobState,
    ModelRow,
    StageName,
    StageRow,
    StageState,
    UploadState,
)
from l3ps_platform.catalog.models import UploadRow

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
    for job, case in service.jobs.items():
        assert states[job] is expected.get(job, JobState.SUCCEEDED), (job, str(case), service.job(job).error)
        if states[job] is JobState.SUCCEEDED:
            assert labels(service, job) == baseline[case], f"{job}: other labels than undisturbed: {case}"
    _done_once(service, states)
    _nothing_held(service)
    _no_orphans(service, states)
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


def _done_once(service: Service, states: Mapping[str, JobState]) -> None:
    stages = service.stages(StageRow.job_id.is_not(None))
    planned = Counter((stage.job_id, stage.scene_id, stage.name) for stage in stages)
    assert set(planned.values()) <= {1}, "a stage was planned twice"
    for stage in stages:
        if states[stage.job_id or ""] is JobState.SUCCEEDED:
            assert stage.state is StageState.DONE, (stage.id, stage.state, stage.error)
    manifests = {job for job in states if service.store.exists(f"jobs/{job}/manifest.json")}
    published = {stage.job_id for stage in stages if stage.name is StageName.PUBLISH and stage.state is StageState.DONE}
    assert manifests == published, f"manifests of {manifests - published}, none of {published - manifests}"


def _nothing_held(service: Service) -> None:
    held = service.stages(StageRow.lease_owner.is_not(None))
    assert not held, f"leases left: {[stage.id for stage in held]}"
    # Workers acknowledge a message after its row is written, and drop the copies that were sent meanwhile.
    wait_until(lambda: not service.servers.redis.left(), f"messages left: {service.servers.redis.left()}", 20)


def _no_orphans(service: Service, states: Mapping[str, JobState]) -> None:
    assert not service.servers.minio.multipart_uploads(), "multipart uploads left"
    from sqlalchemy import select

    with service.catalog.reading() as session:
        kept = set(session.scalars(select(DriveRow.object_key))) | set(session.scalars(select(ModelRow.object_key)))
        open_uploads = list(session.scalars(select(UploadRow.id).where(UploadRow.state == UploadState.OPEN)))
    assert not open_uploads, f"uploads left open: {open_uploads}"
    for stage in service.stages(StageRow.output_key.is_not(None)):
        assert stage.output_key is not None
        kept.add(stage.output_key)
        if stage.name in (StageName.REFINE, StageName.PUBLISH):
            kept |= {file["key"] for file in json.loads(service.store.get_bytes(stage.output_key))["files"]}
    orphans = {info.key for info in service.store.list()} - kept
    # A stage that was cancelled or failed may have stored some of its outputs; those are for the sweeper, by age.
    swept = {key for key in orphans if key.startswith("stages/")}
    unfinished = [state for state in states.values() if state is not JobState.SUCCEEDED]
    assert not orphans - swept, f"objects without a row: {sorted(orphans - swept)}"
    assert not swept or unfinished, f"outputs without a row though every job succeeded: {sorted(swept)}"
    if swept:
        service.note("objects left to the sweeper", len(swept))
