"""Servers and workers that are not dead and do not answer: connections stay open, nothing comes."""

import time

from chaoslib.servers import silenced, wait_until

from l3ps_platform.catalog import StageRow

SILENT_SECONDS = 6.0
"""Twice a lease of these scenarios."""


def outlast(seconds: float) -> None:
    """Silence is a stretch of time; there is nothing to wait for."""
    time.sleep(seconds)


def test_silent_servers(scenario, ends_well) -> None:
    """SIGSTOP of Redis, of MinIO and of PostgreSQL in turn, in mid-job, for two leases each, then SIGCONT."""
    service = scenario(faults=[{"stage": "segment", "fault": "slow", "seconds": 0.5}])
    service.begin()
    service.start_worker(concurrency=2)
    for server in (service.servers.redis, service.servers.minio, service.servers.postgres):
        service.at_work()
        with server.silent():
            outlast(SILENT_SECONDS)
    ends_well(service)
    assert scenario.facts["failures counted"] == 0


def test_silent_worker(scenario, ends_well) -> None:
    """SIGSTOP of a whole worker in mid-stage for two leases, and SIGCONT when another has done its work."""
    service = scenario(faults=[{"stage": "refine", "fault": "slow", "seconds": 1.0, "nth": [1, 2]}])
    service.begin()
    first = service.start_worker("w1")
    stage = service.at_work("refine", first)
    with silenced(first.pid):
        service.start_worker("w2")
        outlast(SILENT_SECONDS)
        wait_until(lambda: _done(service, stage.id), "nobody else did it", 60)
    assert first.running()
    ends_well(service)
    runs = [attempt for id, attempt in service.runs() if id == stage.id]
    assert len(runs) == 2, runs


def _done(service, id: str) -> bool:
    return service.stages(StageRow.id == id)[0].state.final
