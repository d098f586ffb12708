"""Two APIs over one catalog: two reconcilers, two deliverers, two sweepers."""

from chaoslib.receiver import slowly
from chaoslib.servers import wait_until
from chaoslib.stack import free_port

from l3ps_platform.catalog import DeliveryRow

KILLS = 4


def test_two_apis(scenario, ends_well) -> None:
    """Two APIs; four times the one that has webhook deliveries in hand is killed and started again."""
    service = scenario(witness=slowly(0.4), faults=[{"stage": "segment", "fault": "slow", "seconds": 0.3}])
    service.begin()
    port = free_port()
    apis = [service.api, service.start_api("api-2", port)]
    service.start_worker(concurrency=2)
    service.at_work()
    for turn in range(KILLS):
        victim = apis[turn % 2]

        def delivering(pid: int = victim.pid) -> list[DeliveryRow]:
            return service.rows(DeliveryRow, DeliveryRow.lease_owner.like(f"%:{pid}:%"))

        wait_until(delivering, "it delivered nothing", 60)
        service.kill(victim)
        apis[turn % 2] = service.start_api() if turn % 2 == 0 else service.start_api("api-2", port)
    ends_well(service)
    runs = service.runs()
    assert len(runs) == len(set(runs)) == len(service.stages()), "a stage ran more than once"
    assert scenario.facts["attempts beyond the first"] == 0
    assert scenario.facts["messages repeated"] <= 8 * KILLS  # at least once: what was in hand comes again
