"""From an object that arrived in a bucket to a job."""

from __future__ import annotations

import time

import structlog

from l3ps.errors import InputError
from l3ps_platform.catalog import rules
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.catalog.source_rows import ArrivalRow
from l3ps_platform.errors import NotFound
from l3ps_platform.workflow.planning import accept_source, error_json, submit_job

log = structlog.get_logger(__name__)


def settle_arrivals(catalog: Catalog, seconds: float, limit: int = 1000) -> int:
    """Make jobs of arrivals that wait for it, for so long at most; how many were settled.

    Each in a transaction of its own: whatever happens in between, an arrival is one job or none yet. Several may do
    this at once.

    Args:
        catalog: of one project, or of all.
        seconds: after which the rest is left to the next call.
        limit: how many at most.
    """
    end, count = time.monotonic() + seconds, 0
    with catalog.reading() as session:
        found = rules.waiting(session, limit)
    for arrival in found:
        if time.monotonic() > end:
            break
        with catalog.scoped(arrival.project_id).transaction() as tx:
            row = rules.lock_waiting(tx.session, arrival.id)
            if row is not None:
                _settle(tx, row)
                count += 1
    return count


def _settle(tx: Transaction, arrival: ArrivalRow) -> None:
    settings = rules.get(tx.session, arrival.rule_id).settings
    arrival.settled_at = tx.now
    try:
        with tx.session.begin_nested():
            drive = accept_source(tx, source=arrival.source)
            arrival.job_id = submit_job(tx, drive_id=drive.id, **settings).id
    except (InputError, NotFound) as error:
        tx.outbox.clear()
        arrival.error = error_json(error)
        log.warning("arrival without a job", rule=arrival.rule_id, source=arrival.source, reason=str(error))
    tx.session.flush()
