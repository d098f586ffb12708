"""Rate limits in the memory of the process: a few hundred nanoseconds a request, nothing to run beside it.

Several API processes each allow the rate; a limit over all of them belongs to what balances between them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from l3ps_api.problems import ApiProblem, fault


class Buckets:
    """One token bucket for each caller, kept as the time at which it is full again.

    Args:
        rate: requests a second in the long run.
        burst: requests at once from a full bucket.
        clock: seconds that never go back.
        size: callers remembered; the one that asked longest ago is forgotten first.
    """

    def __init__(
        self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic, size: int = 100_000
    ) -> None:
        self._step, self._slack = 1 / rate, (burst - 1) / rate
        self._clock, self._size = clock, size
        self._full_at: dict[str, float] = {}  # in the order of the last request

    def take(self, caller: str) -> float:
        """Count a request if the caller may ask now; the seconds to wait if not, 0 if so."""
        now = self._clock()
        full_at = max(self._full_at.pop(caller, now), now)
        wait = full_at - self._slack - now
        self._full_at[caller] = full_at if wait > 0 else full_at + self._step
        if len(self._full_at) > self._size:
            del self._full_at[next(iter(self._full_at))]
        return max(0.0, wait)

    def wait(self, caller: str) -> float:
        """The seconds until the caller may ask, 0 if now; counts nothing."""
        now = self._clock()
        return max(0.0, self._full_at.get(caller, now) - self._slack - now)


def too_many(seconds: float, what: str) -> ApiProblem:
    """429 for a caller that must wait."""
    after = max(1, math.ceil(seconds))
    remedy = f"Wait {after} s (Retry-After) and ask less often."
    headers = {"Retry-After": str(after)}
    return fault(429, "too-many-requests", "Too many requests", "request rate", what, remedy, headers)


def over_quota(where: str, limit: int, noun: str, remedy: str) -> ApiProblem:
    """429 for a project that has as many of something as it may."""
    what = f"the project has {limit} {noun}, as many as it may"
    return fault(429, "quota-reached", "Quota reached", where, what, remedy, {"Retry-After": "30"})
