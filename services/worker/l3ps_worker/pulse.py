"""The worker's pulse: ``python -m l3ps_worker.pulse``, one small process beside the pool, started by the main process.

It prolongs the leases of the stages that the pool's children hold, as long as the children live, and kills a child that
goes on with a job that was cancelled, because it is deep in compiled code or waits for a server. A thread in the child
could not: hdbscan holds the interpreter lock, more than 120 s at a time for 1.8 M points on a busy machine, and a lease
that runs out under a worker at work costs the whole stage. A child that lives but does not get on is the business of
the time limit; one that could not record how its stage ended dies (l3ps_worker.app), so that to live is to be at work.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import structlog

from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, StageName, stages
from l3ps_platform.errors import PlatformError
from l3ps_platform.processes import die_with, is_child
from l3ps_platform.settings import Settings, get_settings
from l3ps_platform.telemetry import configure_logging
from l3ps_worker.trainer import LEAVE_SECONDS

log = structlog.get_logger(__name__)


class Pulse:
    """The pulse as its parent sees it: a child process that is started again should it be killed.

    Args:
        owner_prefix: how the names of the owners below this worker begin.
    """

    def __init__(self, owner_prefix: str) -> None:
        self._command = [sys.executable, "-P", "-m", "l3ps_worker.pulse", owner_prefix, str(os.getpid())]
        self._stopping = False
        self._process = subprocess.Popen(self._command)
        # The thread waits in the kernel and holds no lock, so children may be forked beside it.
        threading.Thread(target=self._watch, name="pulse", daemon=True).start()

    def stop(self) -> None:
        """End it for good."""
        self._stopping = True
        self._process.terminate()

    def _watch(self) -> None:
        while True:
            self._process.wait()
            if self._stopping:
                return
            log.warning("pulse stopped, starting it again", status=self._process.returncode)
            time.sleep(1)  # a pulse that cannot start is no reason to burn the processor
            self._process = subprocess.Popen(self._command)


class Overdue:
    """The children of ``parent`` that go on with what was cancelled.

    Args:
        owner_prefix: how the names of their owners begin.
        parent: the worker's main process.
        seconds: how long they may go on; those that train may in addition let the trainer write its checkpoint.
    """

    def __init__(self, owner_prefix: str, parent: int, seconds: float) -> None:
        self._prefix, self._parent, self._seconds = owner_prefix, parent, seconds
        self._since: dict[tuple[str, str], float] = {}

    def kill(self, catalog: Catalog) -> int:
        """Kill those whose time is up; how many. The main process then reports them, and their stages are cancelled."""
        count, now = 0, time.monotonic()
        with catalog.transaction() as tx:
            asked = {(id, owner): name for id, owner, name in stages.cancelled_of(tx.session, self._prefix)}
            self._since = {held: self._since.get(held, now) for held in asked}
            for (id, owner), name in asked.items():
                allowed = self._seconds + (LEAVE_SECONDS if name is StageName.TRAIN else 0.0)
                pid = int(owner.rpartition(":")[2])
                if now - self._since[id, owner] >= allowed and is_child(pid, self._parent):
                    log.warning("killing a child that goes on after its job was cancelled", stage=id, pid=pid)
                    os.kill(pid, signal.SIGKILL)
                    count += 1
        return count


def beat(catalog: Catalog, owner_prefix: str, parent: int, lease_seconds: float) -> int:
    """Prolong the leases that living children of ``parent`` hold; how many."""

    def lives(owner: str) -> bool:
        return is_child(int(owner.rpartition(":")[2]), parent)

    with catalog.transaction() as tx:
        return workflow.prolong(tx, owner_prefix, lives, lease_seconds)


def main(owner_prefix: str, parent: int, settings: Settings) -> None:
    """Beat until the parent ends it, or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    die_with(parent)
    configure_logging(settings, "pulse")
    catalog = Catalog(settings.catalog_url)
    overdue = Overdue(owner_prefix, parent, settings.cancel_seconds)
    while True:
        time.sleep(settings.heartbeat_seconds)
        try:
            beat(catalog, owner_prefix, parent, settings.lease_seconds)
            overdue.kill(catalog)
        except PlatformError as error:
            log.warning("heartbeat missed", reason=str(error))
        except Exception:
            log.exception("heartbeat failed")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), get_settings())
