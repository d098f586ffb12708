"""When a delivery that failed is tried again."""

from __future__ import annotations

import random
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime

JITTER = 0.2
"""A wait is up to this share longer: what failed together is not tried again together."""

LONGEST = timedelta(days=1)
"""A receiver may ask for no longer wait than the schedule's last one."""


def wait_before(waits: Sequence[float], attempts: int, retry_after: timedelta | None = None) -> timedelta | None:
    """How long to wait before the next attempt, or None when the schedule is exhausted.

    Args:
        waits: seconds before each attempt, the first one included.
        attempts: how many were made.
        retry_after: what the receiver asked for; it can only prolong the wait.
    """
    if attempts >= len(waits):
        return None
    wait = timedelta(seconds=waits[attempts] * (1 + random.uniform(0, JITTER)))
    return max(wait, min(retry_after or wait, LONGEST))


def read_retry_after(value: str | None, now: datetime) -> timedelta | None:
    """A ``Retry-After`` header, seconds or a date; None when there is none or it says nothing."""
    if value is None:
        return None
    if value.isascii() and value.strip().isdigit():
        return timedelta(seconds=min(int(value.strip()[:9]), LONGEST.total_seconds()))
    try:
        moment = parsedate_to_datetime(value)
    except (ValueError, TypeError):
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return max(moment - now, timedelta())
