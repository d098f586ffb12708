"""The broom: finds what crashes, lost messages and impatient clients leave behind, and puts it right.

Runs in a thread of the API; several may run at once, since every change is conditional.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import structlog
from sqlalchemy import ColumnElement, select, update

from l3ps_platform.catalog.attempt_rows import Outcome
from l3ps_platform.catalog.models import StageRow
from l3ps_platform.catalog.session import Catalog, Transaction
from l3ps_platform.catalog.states import StageName, StageState
from l3ps_platform.errors import CatalogUnavailable
from l3ps_platform.settings import Settings
from l3ps_platform.workflow.arrivals import settle_arrivals
from l3ps_platform.workflow.attempts import note_end
from l3ps_platform.workflow.causes import Cause, failure
from l3ps_platform.workflow.chores import Chore
from l3ps_platform.workflow.claims import LOST, changed, lock_parents
from l3ps_platform.workflow.outcomes import failed
from l3ps_platform.workflow.planning import enqueue
from l3ps_platform.workflow.resending import Resender
from l3ps_platform.workflow.retries import Retry

if TYPE_CHECKING:  # celery takes a third of a second to import, and only senders need it
    from l3ps_platform.queue import Queue

log = structlog.get_logger(__name__)

BATCH = 200


@dataclass(frozen=True, slots=True)
class Report:
    """How much one round put right."""

    expired: int = 0
    hanging: int = 0
    retried: int = 0
    resent: int = 0
    spent: int = 0
    arrivals: int = 0


class Reconciler:
    """Rounds over the catalog.

    Args:
        catalog: whose sender is ``queue.send``.
        queue: to see which messages are still on their way.
        settings: intervals and limits.
    """

    def __init__(self, catalog: Catalog, queue: Queue, settings: Settings) -> None:
        self._catalog = catalog.heard(self._bear_slowness)
        self._queue = queue
        self._settings = settings
        self._resender = Resender(self._catalog, queue, settings)
        self._retry = Retry.of(settings)
        self._leases_count_from = float("-inf")
        self._steps: dict[str, Callable[[], int]] = {
            "expired": self._expire_leases,
            "hanging": self._end_hanging,
            "retried": self._release_retries,
            "resent": self._resender.run_once,
            "spent": self._drop_spent,
            "arrivals": self._settle_arrivals,
        }
        self.chore = Chore("reconciler", *self._steps)

    def run(self, stop: threading.Event) -> None:
        """Rounds until ``stop`` is set."""
        self._bear_old_leases()
        while not stop.wait(self._settings.reconcile_seconds):
            report = self.run_once()
            if report != Report():
                log.info("reconciled", **{name: getattr(report, name) for name in Report.__slots__})

    def run_once(self) -> Report:
        """One round. A step that fails is tried again in the next one, and keeps no other from its turn."""
        done: dict[str, int] = {}
        for name, work in self._steps.items():
            with self.chore.step(name):
                try:
                    done[name] = work()
                except CatalogUnavailable:
                    self._bear_outage()
                    raise
        return Report(**done)

    def _bear_old_leases(self) -> None:
        """For a lease's time to come, do not conclude from one that has run out that its worker is gone.

        While the catalog was away nobody could prolong any; and who has just started does not know whether it was.
        """
        self._leases_count_from = time.monotonic() + self._settings.lease_seconds

    def _bear_outage(self) -> None:
        """Bear them where the catalog is away, and not where it ended one transaction, as it does in a deadlock."""
        try:
            self._catalog.ping()
        except CatalogUnavailable:
            self._bear_old_leases()

    def _bear_slowness(self, seconds: float) -> None:
        """Bear them after a transaction so long that the catalog may have been silent, to workers as well."""
        if seconds > self._settings.lease_seconds / 3:
            self._bear_old_leases()

    def _expire_leases(self) -> int:
        # One time for all, and a look at how long its answer took: a transaction that waits for a silent catalog reads
        # a clock that has gone on meanwhile, and would end leases that nobody could prolong.
        now = self._now()
        if time.monotonic() < self._leases_count_from:
            return 0
        count = 0
        for stage_id in self._ids(StageRow.state == StageState.RUNNING, StageRow.lease_until < now):
            with self.chore.row("expired", stage_id), self._catalog.transaction() as tx:
                count += lease_lost(tx, stage_id, self._retry, expired_before=now)
        return count

    def _end_hanging(self) -> int:
        """End what runs beyond its time limit under a lease that goes on: its worker ought to have ended it."""
        count = 0
        for training in (True, False):
            limit = self._settings.train_seconds if training else self._settings.stage_seconds
            kind = (StageRow.name == StageName.TRAIN) if training else (StageRow.name != StageName.TRAIN)
            # Two leases later than the worker: by then it has ended the stage, or has lost it.
            since = self._now() - timedelta(seconds=limit + 2 * self._settings.lease_seconds)
            reason = f"it ran for more than {limit:.0f} s and its worker did not stop it"
            for stage_id in self._ids(StageRow.state == StageState.RUNNING, kind, StageRow.started_at < since):
                with self.chore.row("hanging", stage_id), self._catalog.transaction() as tx:
                    count += lease_lost(
                        tx, stage_id, self._retry, started_before=since, reason=reason, cause=Cause.TIMEOUT
                    )
        return count

    def _release_retries(self) -> int:
        count = 0
        waiting = (StageRow.state == StageState.WAITING, StageRow.not_before.is_not(None))
        for stage_id in self._ids(*waiting, StageRow.not_before <= self._now()):
            with self.chore.row("retried", stage_id), self._catalog.transaction() as tx:
                stage = tx.session.get(StageRow, stage_id)
                if stage is None:
                    continue
                lock_parents(tx, stage)
                due = update(StageRow).where(StageRow.id == stage_id, *waiting, StageRow.not_before <= tx.now)
                if changed(tx, due.values(state=StageState.QUEUED)):
                    tx.session.refresh(stage)
                    enqueue(tx, stage)
                    count += 1
        return count

    def _drop_spent(self) -> int:
        """Forget messages that a killed worker left delivered for ever, once there is nothing left to do for them."""
        delivered = self._queue.delivered()
        if not delivered:
            return 0
        wanted = (StageRow.id.in_({stage_id for stage_id, _ in delivered.values()}), ~_over())
        with self._catalog.reading() as session:
            alive = {
                (id, attempt) for id, attempt in session.execute(select(StageRow.id, StageRow.attempt).where(*wanted))
            }
        spent = [tag for tag, pair in delivered.items() if pair not in alive]
        if spent:
            self._queue.drop(spent)
        return len(spent)

    def _settle_arrivals(self) -> int:
        seconds, most = self._settings.reconcile_seconds, self._settings.max_active_jobs
        return settle_arrivals(self._catalog, seconds, most, self.chore)

    def _ids(self, *conditions: object) -> list[str]:
        with self._catalog.reading() as session:
            query = select(StageRow.id).where(*conditions).order_by(StageRow.id).limit(BATCH)  # type: ignore[arg-type]
            return list(session.scalars(query))

    def _now(self) -> datetime:
        with self._catalog.reading() as session:
            return self._catalog.now(session)


def _over() -> ColumnElement[bool]:
    return StageRow.state.in_([state for state in StageState if state.final])


def lease_lost(
    tx: Transaction,
    stage_id: str,
    retry: Retry,
    *,
    expired_before: datetime | None = None,
    started_before: datetime | None = None,
    owner_prefix: str | None = None,
    reason: str | None = None,
    cause: Cause = Cause.LEASE_LOST,
) -> bool:
    """End a running attempt whose worker is gone: tried again, failed for good, or cancelled with its job.

    Args:
        tx: the transaction.
        stage_id: the stage.
        retry: how often it may be tried.
        expired_before: only if its lease ended before this.
        started_before: only if it began before this.
        owner_prefix: only if its owner's name begins so (a worker's main process reports its own dead child).
        reason: what to tell the user.
        cause: and in one word.
    """
    stage = tx.session.get(StageRow, stage_id)
    if stage is None:
        return False
    lock_parents(tx, stage)
    conditions = [StageRow.id == stage_id, StageRow.state == StageState.RUNNING]
    if expired_before is not None:
        conditions.append(StageRow.lease_until < expired_before)
    if started_before is not None:
        conditions.append(StageRow.started_at < started_before)
    if owner_prefix is not None:
        conditions.append(StageRow.lease_owner.startswith(owner_prefix, autoescape=True))
    error = LOST if reason is None else failure(reason, cause)
    values = {"state": StageState.FAILED, "lease_owner": None, "lease_until": None, "finished_at": tx.now}
    if not changed(tx, update(StageRow).where(*conditions).values(**values, error=error)):
        return False
    note_end(tx, stage, Outcome.FAILED, error=error)
    tx.session.refresh(stage)
    failed(tx, stage, retry, Outcome.LOST)
    return True
