"""Another release takes over in mid-job."""

from chaoslib.servers import wait_until

from l3ps_platform.catalog import StageName, StageRow, StageState


def test_upgraded_between_segment_and_refine(scenario, ends_well) -> None:
    """Jobs whose scenes are segmented by one release and refined by the next, whose code for everything is another:
    all at once, and with workers of both side by side."""
    service = scenario()
    service.begin()
    old = service.start_worker("old", concurrency=2, queues="refine")
    wait_until(lambda: not service.stages(*_OPEN, StageRow.name == StageName.INGEST), "drives were not checked", 60)
    service.stop(old)
    old = service.start_worker("old", concurrency=2, queues="segment")
    wait_until(lambda: len(_segmented(service)) >= 8, "nothing was segmented", 60)
    service.start_worker("new", concurrency=2, queues="refine", CHAOS_RELEASE="next")
    wait_until(lambda: service.stages(StageRow.name == StageName.REFINE, ~_waits()), "nothing was refined", 60)
    service.note_in_flight()
    service.stop(old)
    service.start_worker("newer", queues="segment,refine", CHAOS_RELEASE="next")
    ends_well(service)
    assert scenario.facts["failures counted"] == 0


_OPEN = (StageRow.state.in_([state for state in StageState if not state.final]),)


def _waits():
    return StageRow.state == StageState.WAITING


def _segmented(service) -> list[StageRow]:
    return service.stages(StageRow.name == StageName.SEGMENT, StageRow.state == StageState.DONE)
