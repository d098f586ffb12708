"""From an object that arrived in a bucket to a job."""

from __future__ import annotations

import time

import structlog

from l3ps.errors import InputError
from l3ps_platform.catalog import quotas, rules
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.catalog.source_rows import ArrivalRow
from l3ps_platform.errors import NotFound
from l3ps_platform.workflow.chores import Chore
from l3ps_platform.workflow.planning import accept_source, error_json, submit_job

log = structlog.get_logger(__name__)


def settle_arrivals(catalog: Catalog, seconds: float, max_active: int, chore: Chore) -> int:
    """Make jobs of arrivals that wait for it, the oldest first; how many were settled.

    Each in a transaction of its own: whatever happens in between, an arrival is one job or none yet. Several may do
    this at once. Those of a project that has as many jobs under way as it may go on waiting.

    Args:
        catalog: of one project, or of all.
        seconds: after which the rest is left to the next call.
        max_active: jobs and trainings that a project may have under way.
        chore: bears and counts what goes wrong about one: it waits on, and those behind it do not wait for it.
    """
    end, count, last = time.monotonic() + seconds, 0, ""
    full: set[str] = set()
    while True:
        with catalog.reading() as session:
            found = rules.waiting(session, after=last, without=full)
        for arrival in found:
            if time.monotonic() > end:
                return count
            last = arrival.id
            if arrival.project_id in full:
                continue
            own = catalog.scoped(arrival.project_id)
            with own.reading() as session:
                if quotas.active_jobs(session) >= max_active:
                    full.add(arrival.project_id)
                    continue
            with chore.row("arrivals", arrival.id):
                count += _settle(own, arrival)
        if not found:
            return count


def _settle(catalog: Catalog, arrival: ArrivalRow) -> bool:
    """Whether it was settled here, and not elsewhere in this moment."""
    try:
        with catalog.transaction() as tx:
            row = _taken(tx, arrival)
            if row is not None:
                settings = rules.get(tx.session, row.rule_id).settings
                drive = accept_source(tx, source=row.source)
                row.job_id = submit_job(tx, drive_id=drive.id, **settings).id
            return row is not None
    except (InputError, NotFound) as error:
        log.warning("arrival without a job", rule=arrival.rule_id, source=arrival.source, reason=str(error))
        with catalog.transaction() as tx:
            row = _taken(tx, arrival)
            if row is not None:
                row.error = error_json(error)
            return row is not None


def _taken(tx: Transaction, arrival: ArrivalRow) -> ArrivalRow | None:
    row = rules.lock_waiting(tx.session, arrival.id)
    if row is not None:
        row.settled_at = tx.now
    return row
