"""Sends again what waits in the catalog and is not in its queue: lost with Redis, or never sent."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import TYPE_CHECKING

from l3ps_platform.catalog import stages
from l3ps_platform.catalog.session import Catalog, StageMessage
from l3ps_platform.catalog.states import QueueName
from l3ps_platform.settings import Settings

if TYPE_CHECKING:  # celery takes a third of a second to import, and only senders need it
    from datetime import datetime

    from l3ps_platform.queue import Queue

BATCH = 1000
"""Messages sent in one round for each queue: the reconciler has other duties."""


class Resender:
    """Compares the catalog with the queues, and sends what is missing.

    A look covers all that waits, however much that is: behind a backlog lost messages would otherwise stay lost. It
    reads queues whole, so there is one at most every ``resend_seconds``, and none while nothing is overdue.

    Args:
        catalog: whose sender is ``queue.send``.
        queue: to see which messages are still on their way.
        settings: when a stage is overdue.
    """

    def __init__(self, catalog: Catalog, queue: Queue, settings: Settings) -> None:
        self._catalog = catalog
        self._queue = queue
        self._seconds = settings.resend_seconds
        self._next_look = float("-inf")
        self._stale: datetime | None = None
        self._lost: dict[QueueName, list[str]] = {}

    def run_once(self) -> int:
        """One round; how many messages were sent. QueueUnavailable."""
        if not any(self._lost.values()):
            if time.monotonic() < self._next_look:
                return 0
            self._next_look = time.monotonic() + self._seconds
            self._look()
        return sum(self._send(name) for name in self._lost)

    def _look(self) -> None:
        with self._catalog.reading() as session:
            self._stale = self._catalog.now(session) - timedelta(seconds=self._seconds)
            overdue = {name: stages.overdue(session, name, self._stale) for name in QueueName}
        self._lost = {}
        for name, waiting in overdue.items():
            if waiting:
                on_their_way = self._queue.pending(name)
                self._lost[name] = [id for id, attempt in waiting if (id, attempt) not in on_their_way]

    def _send(self, name: QueueName) -> int:
        lost, self._lost[name] = self._lost[name][:BATCH], self._lost[name][BATCH:]
        if not lost or self._stale is None:
            return 0
        with self._catalog.transaction() as tx:
            # As they are now: since the look they may have been taken, or sent by another process.
            for stage in stages.hold_overdue(tx.session, lost, self._stale):
                stage.queued_at = tx.now
                tx.outbox.append(StageMessage(stage.id, stage.attempt, stage.name, stage.queue))
            return len(tx.outbox)
