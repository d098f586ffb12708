"""Whether and when a stage whose attempt failed is tried again."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from l3ps_platform.catalog.models import StageRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.settings import Settings
from l3ps_platform.workflow.causes import stored_cause


@dataclass(frozen=True, slots=True)
class Retry:
    """How often and how long a stage may be tried.

    Attributes:
        max_attempts: how often it may fail by a fault of its own: a crash, too little memory, a bug.
        seconds: the wait before the second time; it doubles each time.
        outage_seconds: how long it is tried while what it stands on is away; that uses up no attempt.
        longest_seconds: the longest wait between two tries.
    """

    max_attempts: int
    seconds: float
    outage_seconds: float = 6 * 3600.0
    longest_seconds: float = 60.0

    @classmethod
    def of(cls, settings: Settings) -> Retry:
        """As the service's settings have it."""
        return cls(
            settings.max_attempts, settings.retry_seconds, settings.outage_seconds, settings.outage_retry_seconds
        )


def next_try(tx: Transaction, stage: StageRow, retry: Retry) -> datetime | None:
    """Count a failure by its cause and say when the stage may run again; None for never."""
    if stored_cause(stage.error).environmental:
        stage.outage_since = stage.outage_since or tx.now
        lasted = (tx.now - stage.outage_since).total_seconds()
        wait = max(lasted, retry.seconds)  # as long as it has lasted: the waits double
        return None if lasted >= retry.outage_seconds else tx.now + timedelta(seconds=min(wait, retry.longest_seconds))
    stage.outage_since = None
    stage.failures += 1
    if stage.failures >= retry.max_attempts:
        return None
    return tx.now + timedelta(seconds=retry.seconds * 2 ** (stage.failures - 1))
