"""What a stage reports while it runs, and what that brings back: lease lost, job cancelled, worker stopping."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import structlog

from l3ps.errors import L3psError
from l3ps_platform import workflow
from l3ps_platform.errors import CatalogUnavailable
from l3ps_worker.context import Context

log = structlog.get_logger(__name__)


class Stopping(L3psError):  # noqa: N818  (a request carried out, not an error)
    """The worker is to stop: give the stage back."""


class StageProgress:
    """Progress as the method reports it, written to the stage's row now and then.

    A catalog that is away for a while is borne: the lease may run out meanwhile, and then the row decides.

    Args:
        context: the worker.
        claim: the stage.
        steps: names of the steps the stage goes through, in order, with the share of each in the overall fraction;
            without shares each counts the same.

    Calling it raises :class:`l3ps.errors.Cancelled`, :class:`Stopping` or ``LeaseLost`` when the work is to end.
    """

    def __init__(self, context: Context, claim: workflow.Claim, steps: Sequence[str] | Mapping[str, float]) -> None:
        self._context = context
        self._claim = claim
        self._shares = dict(steps) if isinstance(steps, Mapping) else dict.fromkeys(steps, 1.0)
        self._written = float("-inf")
        self._fraction = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report ``done`` of ``total`` units of the step ``stage``."""
        if self._context.stopping.is_set():
            raise Stopping("the worker is stopping")
        now = time.monotonic()
        if now - self._written < self._context.settings.progress_seconds:
            return
        self._written = now
        if stage in self._shares:
            names, shares = list(self._shares), list(self._shares.values())
            share = sum(shares[: names.index(stage)]) + self._shares[stage] * (done / total if total else 1.0)
            self._fraction = max(self._fraction, min(share / sum(shares), 1.0))
        try:
            with self._context.catalog.transaction() as tx:
                workflow.report(tx, self._claim, stage, done, total, fraction=self._fraction)
        except CatalogUnavailable as error:
            log.warning("progress not written", reason=str(error))
