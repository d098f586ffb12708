"""The whole service in one process tree, as on a laptop, and what happens when parts of it are killed."""

import os
import signal

from chaoslib.workload import CASES


def test_embedded_killed(scenario, ends_well) -> None:
    """kill -9 in `l3ps up` of the worker's child, of the worker, of the API and of the whole, each with 24 more jobs.

    But for the first the stack ends, leaves nothing running, and is started again.
    """
    service = scenario.embedded()
    service.begin(cases=CASES)
    os.kill(service.child_of(service.at_work()), signal.SIGKILL)
    for part in ("worker", "l3ps_api", None):
        for case in CASES:
            service.submit(case)
        service.at_work()
        os.kill(service.api.pid if part is None else service.below(part), signal.SIGKILL)
        code = service.left(service.api)
        assert code == -signal.SIGKILL if part is None else code not in (0, None), (part, code)
        service.start_api()
    ends_well(service)
    assert len(service.all_jobs()) == 4 * len(CASES)
