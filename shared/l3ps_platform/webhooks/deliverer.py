"""The deliverer: makes the deliveries that the catalog lists.

Runs in a thread of the API; several processes may, since a claim decides who makes a delivery. In the thread runs an
event loop, because only there a receiver that sends a byte a second can be cut off as a whole, and everything in flight
at once when the process stops.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import timedelta

import structlog

from l3ps_platform.catalog import Catalog, events, webhooks
from l3ps_platform.errors import NotFound, PlatformError
from l3ps_platform.settings import Settings
from l3ps_platform.webhooks.guard import Guard
from l3ps_platform.webhooks.schedule import wait_before
from l3ps_platform.webhooks.sending import Answer, attempt
from l3ps_platform.workflow import deliveries
from l3ps_platform.workflow.chores import Chore
from l3ps_platform.workflow.deliveries import Parcel

log = structlog.get_logger(__name__)

IN_FLIGHT = 16
"""Attempts at once in this process."""
SHARE = IN_FLIGHT // 2
"""Of them, those of one project: however many of its receivers hang, others find room."""

LOOK_SECONDS = 0.5
"""How often the catalog is asked what is due."""

RECORD_SECONDS = 10.0
"""A delivery's lease outlasts its attempt by this, to write down how it ended; then somebody else makes it again."""

PRUNE_SECONDS = 3600.0


class Deliverer:
    """Rounds over what is due.

    Args:
        catalog: of all projects.
        settings: what may be reached, how long an attempt takes, when it is repeated.
    """

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._settings = settings
        self._guard = Guard(settings.webhook_allow, http=settings.webhook_http)
        self._owner = f"{socket.gethostname()[:32]}:{os.getpid()}:{secrets.token_hex(4)}"
        self._pruned = float("-inf")
        self.chore = Chore("deliverer", "take", "deliver", "prune")

    def run(self, stop: threading.Event) -> None:
        """Deliver until ``stop`` is set; what is in flight then is given back and made again by whoever comes next."""
        asyncio.run(self._rounds(stop))

    async def _rounds(self, stop: threading.Event) -> None:
        loop = asyncio.get_running_loop()
        # Name servers that do not answer must not keep the catalog's threads from us.
        loop.set_default_executor(ThreadPoolExecutor(2 * IN_FLIGHT + 2, "webhooks"))
        flights: dict[asyncio.Task[None], Parcel] = {}
        while not stop.is_set():
            with self.chore.step("take"):
                for parcel in await asyncio.to_thread(self._take, IN_FLIGHT - len(flights)):
                    flights[asyncio.create_task(self._deliver(parcel))] = parcel
            if loop.time() - self._pruned > PRUNE_SECONDS:
                self._pruned = loop.time()
                with self.chore.step("prune"):
                    await asyncio.to_thread(self._prune)
            landed = await self._wait(flights)
            for task in landed:
                del flights[task]
        for task in flights:
            task.cancel()
        await asyncio.gather(*flights, return_exceptions=True)
        if flights:
            await asyncio.to_thread(self._put_back, list(flights.values()))

    async def _wait(self, flights: Iterable[asyncio.Task[None]]) -> set[asyncio.Task[None]]:
        """Until the next look, or a landing, which makes room; the tasks that landed."""
        pause = asyncio.create_task(asyncio.sleep(LOOK_SECONDS))
        done, _ = await asyncio.wait({pause, *flights}, return_when=asyncio.FIRST_COMPLETED)
        pause.cancel()
        return done - {pause}

    async def _deliver(self, parcel: Parcel) -> None:
        seconds = self._settings.webhook_timeout_seconds
        answer = await attempt(self._guard, parcel.url, parcel.secrets, parcel.id, parcel.body, seconds)
        with self.chore.step("deliver"):  # what is not recorded is made again when its lease is over
            await asyncio.to_thread(self._record, parcel, answer)

    def _take(self, limit: int) -> list[Parcel]:
        if limit <= 0:
            return []
        with self._catalog.reading() as session:
            if not webhooks.any_waiting(session, self._catalog.now(session)):
                return []
        lease = self._settings.webhook_timeout_seconds + RECORD_SECONDS
        with self._catalog.transaction() as tx:
            return deliveries.take(tx, self._owner, limit=limit, share=SHARE, lease_seconds=lease)

    def _record(self, parcel: Parcel, answer: Answer) -> None:
        settings = self._settings
        wait = wait_before(settings.webhook_retry_seconds, parcel.attempts + 1, answer.retry_after)
        outcome = deliveries.Attempt(
            answer.status, answer.error, answer.seconds, wait, gone=answer.gone, timed_out=answer.timed_out
        )
        disable_after = timedelta(days=settings.webhook_disable_days)
        with suppress(NotFound), self._catalog.transaction() as tx:  # its webhook was deleted meanwhile
            deliveries.attempted(tx, parcel, outcome, disable_after=disable_after)
        where = {"delivery": parcel.id, "webhook": parcel.webhook_id, "attempt": parcel.attempts + 1}
        if answer.delivered:
            log.info("delivered", **where, seconds=round(answer.seconds, 3))
        else:
            log.info("not delivered", **where, reason=answer.error, again_after=str(wait))

    def _put_back(self, parcels: list[Parcel]) -> None:
        try:
            with self._catalog.transaction() as tx:
                deliveries.put_back(tx, parcels)
        except PlatformError as error:
            log.warning("deliveries not given back, their leases will run out", reason=str(error))

    def _prune(self) -> None:
        with self._catalog.transaction() as tx:
            before = tx.now - timedelta(days=self._settings.event_days)
            events.prune(tx.session, before)
            webhooks.prune_deliveries(tx.session, before)
