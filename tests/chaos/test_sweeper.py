"""The sweeper at work beside running jobs that share outputs with what it deletes."""

import threading

from chaoslib.servers import wait_until
from chaoslib.workload import CASES

from l3ps_platform.catalog import JobRow, OutputRow, OutputState

OLD = {"orphan_seconds": 3.0, "orphans_every_seconds": 1.0}


def test_deleted_while_others_share(scenario, ends_well) -> None:
    """Two jobs of every case one after the other; each finished first one is deleted while the second is under way, the
    bucket is strewn with objects that belong to nobody, and the API that sweeps is killed twice."""
    service = scenario(**OLD, faults=[{"stage": "refine", "fault": "slow", "seconds": 0.2}])
    service.begin()
    strewn = ["uploads/upl_0/x.zip", "jobs/job_0/manifest.json", "stages/prj_default/refine-0/scene.json"]
    for key in strewn:
        service.store.put_bytes(key, b"nobody's")
    firsts = list(service.jobs)
    for case in CASES:
        service.submit(case)
    service.start_worker(concurrency=2)
    service.at_work()
    service.patient = True
    deleted: list[str] = []

    def delete() -> None:
        for job in firsts:
            wait_until(lambda id=job: service.job(id).state.final, "it did not end", 120)
            deleted.append(job) if service.delete(f"/v1/jobs/{job}") else None

    deleting = threading.Thread(target=delete)
    deleting.start()
    for count in (4, 12):
        wait_until(lambda many=count: len(deleted) >= many, "nothing was deleted", 120)
        service.kill(service.api)
        service.start_api()
    deleting.join(120)
    assert len(deleted) == len(firsts)
    service.wait()
    wait_until(
        lambda: not service.rows(JobRow, JobRow.deleted_at.is_not(None), JobRow.swept_at.is_(None)), "unswept", 60
    )
    _swept(service, strewn)
    ends_well(service)


def test_retention(scenario, ends_well) -> None:
    """A project that keeps next to nothing: finished jobs and idle drives are deleted while others are under way."""
    service = scenario(**OLD)
    service.begin()
    service.start_worker(concurrency=2)
    service.at_work()
    service.put_json("/v1/retention", max_age_days=None, max_bytes=1)
    service.wait()
    wait_until(lambda: not service.rows(JobRow, JobRow.swept_at.is_(None)), "jobs are kept", 60)
    _swept(service, [])
    assert not list(service.store.list("stages/")) and not list(service.store.list("jobs/"))
    ends_well(service)


def _swept(service, strewn: list[str]) -> None:
    wait_until(lambda: not service.rows(OutputRow, OutputRow.state == OutputState.DOOMED), "outputs stay doomed", 60)
    wait_until(lambda: not any(service.store.exists(key) for key in strewn), "nobody's objects stay", 60)
