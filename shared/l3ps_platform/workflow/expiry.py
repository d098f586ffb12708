"""Retention: what a project no longer wants to keep is deleted as a client would delete it."""

from __future__ import annotations

from contextlib import suppress
from datetime import timedelta

import structlog

from l3ps_platform.catalog import drives, jobs, outputs, retention
from l3ps_platform.catalog.models import DriveRow, JobRow
from l3ps_platform.catalog.output_rows import RetentionRow
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.errors import Conflict, NotFound
from l3ps_platform.workflow.chores import Chore
from l3ps_platform.workflow.pins import doom_output

log = structlog.get_logger(__name__)


def expire(catalog: Catalog, limit: int, chore: Chore) -> int:
    """Delete the finished jobs and idle drives that are beyond their project's age or size, at most ``limit``.

    The oldest go first; what an unfinished job refers to is no candidate. So go the jobs of deleted projects. Returns
    how many went. One that fails is the chore's to bear.
    """
    with catalog.reading() as session:
        rules = retention.limited(session)
        ownerless = retention.of_closed_projects(session, limit)
    count = 0
    for job in ownerless:
        with chore.row("expired_jobs", job.id):
            count += _delete(catalog, job, "project deleted")
    for rule in rules:
        for act in (_by_age, _by_size):
            with chore.row("expired_jobs", rule.project_id):
                count += act(catalog, rule, limit - count, chore)
    return count


def _by_age(catalog: Catalog, rule: RetentionRow, limit: int, chore: Chore) -> int:
    if rule.max_age_days is None or limit <= 0:
        return 0
    with catalog.reading() as session:
        before = catalog.now(session) - timedelta(days=rule.max_age_days)
        old = [row for _, row in retention.oldest(session, rule.project_id, before=before, limit=limit)]
    count = 0
    for row in old:
        with chore.row("expired_jobs", row.id):
            count += _delete(catalog, row, "age")
    return count


def _by_size(catalog: Catalog, rule: RetentionRow, limit: int, chore: Chore) -> int:
    """One at a time, and then another look: what several jobs share is only free when the last of them is gone."""
    count = 0
    passed: set[str] = set()
    while rule.max_bytes is not None and count + len(passed) < limit:
        with catalog.reading() as session:
            if outputs.stored_bytes(session, rule.project_id) <= rule.max_bytes:
                break
            found = retention.oldest(session, rule.project_id, limit=len(passed) + 1)
        row = next((row for _, row in found if row.id not in passed), None)
        if row is None:
            break
        passed.add(row.id)
        with chore.row("expired_jobs", row.id):
            if _delete(catalog, row, "size"):
                passed.remove(row.id)
                count += 1
    return count


def _delete(catalog: Catalog, row: JobRow | DriveRow, reason: str) -> bool:
    """Whether it went: it may be in use again by now, or gone."""
    with suppress(Conflict, NotFound), catalog.transaction() as tx:
        if isinstance(row, JobRow):
            _delete_job(tx, row.id)
        else:
            drives.delete(tx, row.id)
        log.info("retention", kind=row.noun, id=row.id, project=row.project_id, reason=reason)
        return True
    return False


def _delete_job(tx: Transaction, id: str) -> None:
    jobs.delete(tx, id)
    for key in outputs.of_job(tx.session, id):
        doom_output(tx, key)
