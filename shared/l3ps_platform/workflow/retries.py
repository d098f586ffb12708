"""Whether and when a stage whose attempt failed is tried again."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from l3ps_platform.catalog.models import StageRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.settings import Settings
from l3ps_platform.workflow.causes import Cause, stored_cause


@dataclass(frozen=True, slots=True)
class Retry:
    """How often and how long a stage may be tried.

    Attributes:
        max_attempts: how often it may fail by a fault of its own: a crash, too little memory, a bug.
        seconds: the wait before the second time; it doubles each time.
        outage_seconds: how long it may wait in all for what it stands on and is away; that uses up no attempt.
        longest_seconds: the longest wait between two tries.
        max_losses: how often it may lose its worker as a whole. Nodes that are drained or taken away, reboots and
            upgrades do that to long stages again and again; a scene that takes its machine down does it each time.
    """

    max_attempts: int
    seconds: float
    outage_seconds: float = 6 * 3600.0
    longest_seconds: float = 60.0
    max_losses: int = 10

    @classmethod
    def of(cls, settings: Settings) -> Retry:
        """As the service's settings have it."""
        return cls(
            settings.max_attempts, settings.retry_seconds, settings.outage_seconds, settings.outage_retry_seconds
        )


def next_try(tx: Transaction, stage: StageRow, retry: Retry) -> datetime | None:
    """Count a failure by its cause and say when the stage may run again; None for never."""
    cause = stored_cause(stage.error)
    if cause.environmental:
        # What it has waited and not since when: between two outages it may stand in a queue, or run, for hours.
        if stage.outage_seconds >= retry.outage_seconds:
            return None
        wait = min(max(stage.outage_seconds, retry.seconds), retry.longest_seconds)  # the waits double
        stage.outage_seconds += max(wait, 1.0)  # without a wait the tries would have no end
        return tx.now + timedelta(seconds=wait)
    if cause is Cause.LEASE_LOST:
        stage.losses += 1
        return _backed_off(tx, stage.losses, retry.max_losses, retry)
    stage.outage_seconds = 0.0
    stage.failures += 1
    return _backed_off(tx, stage.failures, retry.max_attempts, retry)


def _backed_off(tx: Transaction, count: int, most: int, retry: Retry) -> datetime | None:
    if count >= most:
        return None
    wait = retry.seconds * 2 ** (count - 1)
    return tx.now + timedelta(seconds=min(wait, max(retry.longest_seconds, retry.seconds)))
