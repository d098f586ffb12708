"""More work than anybody looks at in one go."""

import redis
from chaoslib.servers import wait_until
from chaoslib.workload import CASES

from l3ps_platform.catalog import DriveRow, DriveState, StageName, StageRow, StageState

WAITING = 240


def test_lost_behind_a_backlog(scenario, ends_well) -> None:
    """240 stages wait for a worker that does not come; a message behind them is lost, and is sent again."""
    service = scenario()
    service.begin(cases=[])
    first = service.start_worker("w1", queues="refine")
    wait_until(lambda: all(row.state is DriveState.READY for row in service.rows(DriveRow)), "no drive was ready", 60)
    for case in CASES * (WAITING // len(CASES)):
        service.submit(case)
    assert len(service.stages(StageRow.name == StageName.SEGMENT, StageRow.state == StageState.QUEUED)) == WAITING
    service.stop(first)
    late = service.upload(service.workload.long_drive, "late.zip", "drive")
    with redis.Redis(port=service.servers.redis.port) as queue:
        assert queue.delete("refine") == 1, "its message was not in the queue"
    service.start_worker("w1", queues="refine")
    wait_until(lambda: service.rows(DriveRow, DriveRow.id == late)[0].state is DriveState.READY, "it is lost", 60)
    service.note_in_flight()
    expected = {}
    for job in list(service.jobs)[len(CASES) :]:
        service.post(f"/v1/jobs/{job}/cancel")
        expected[job] = service.job(job).state
    service.start_worker("w2", queues="segment")
    ends_well(service, expected)
