"""One stage from claim to outcome. Celery's tasks are thin around this; tests call it directly."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, TypeVar

import structlog

from l3ps.costs import CostBook
from l3ps.errors import Cancelled, L3psError
from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.catalog import Json, StageName
from l3ps_platform.errors import CatalogUnavailable, LeaseLost
from l3ps_platform.telemetry import bound
from l3ps_worker.context import Context
from l3ps_worker.ingest import ingest
from l3ps_worker.liveness import StageProgress, Stopping
from l3ps_worker.publish import publish
from l3ps_worker.refine import STEPS as REFINE_STEPS
from l3ps_worker.refine import refine
from l3ps_worker.segment import segment
from l3ps_worker.train import STEPS as TRAIN_STEPS
from l3ps_worker.train import train
from l3ps_worker.trainer import TrainerLost
from l3ps_worker.work import Done

log = structlog.get_logger(__name__)

Work = Callable[[Context, workflow.Claim, Progress], Done]
_T = TypeVar("_T")
Outcome = Literal["done", "failed", "cancelled", "released", "lost", "not-claimed"]

WORK: dict[StageName, tuple[Work, Sequence[str] | Mapping[str, float]]] = {
    StageName.INGEST: (ingest, ("fetch", "unpack", "validate", "count")),
    StageName.SEGMENT: (segment, ("segment",)),
    StageName.REFINE: (refine, REFINE_STEPS),
    StageName.PUBLISH: (publish, ("publish",)),
    StageName.TRAIN: (train, TRAIN_STEPS),
}
"""What does each stage, and the steps its progress counts, with their shares where they differ."""


def run_stage(context: Context, stage_id: str, attempt: int) -> Outcome:
    """Claim a stage, do its work and record how it ended. Never raises for what the stage's work does.

    Raises:
        CatalogUnavailable: the catalog is away and the worker is to stop.

    After any exception the row may say that this process still is at work on the stage.
    """
    with bound(stage=stage_id, attempt=attempt):
        lease = context.settings.lease_seconds
        claim = _patiently(
            context, lambda tx: workflow.claim(tx, stage_id, attempt, context.owner, lease_seconds=lease)
        )
        if claim is None:
            log.info("nothing to do for this message")
            return "not-claimed"
        owner = {"job": claim.job_id, "scene": claim.scene_id, "drive": claim.drive_id, "model": claim.model_id}
        owner["training"] = claim.training_id
        with bound(kind=claim.name.value, **owner):
            try:
                return _run_claimed(context, claim)
            except LeaseLost as error:
                log.warning("stage lost", reason=str(error))
                return "lost"


def _run_claimed(context: Context, claim: workflow.Claim) -> Outcome:
    work, steps = WORK[claim.name]
    book = CostBook()
    done: Done | None = None
    try:
        with book.span("stage"):
            done = work(context, claim, StageProgress(context, claim, steps))
    except (LeaseLost, KeyboardInterrupt, SystemExit):
        raise
    except Cancelled:
        return _cancelled(context, claim, _cost(book, done))
    except Stopping:
        return _released(context, claim)
    except Exception as caught:
        # Also a MemoryError: left to Celery, it takes down the worker's main process and comes back with the message.
        return _failed(context, claim, _error(caught), _cost(book, done))
    cost, finish = _cost(book, done), done.finish
    try:
        _patiently(context, lambda tx: finish(tx, claim, cost))
    except (LeaseLost, CatalogUnavailable):
        raise
    except Exception as caught:
        log.error("stage not recorded", exc_info=caught)
        message = f"what it found could not be recorded ({type(caught).__name__})"
        return _failed(context, claim, workflow.failure(message, workflow.cause_of(caught)), cost)
    log.info("stage done", seconds=round(cost.seconds, 3), points=cost.points, cached=cost.cached)
    done.afterwards()
    return "done"


def _patiently(context: Context, act: Callable[[workflow.Transaction], _T]) -> _T:
    """Claim a stage or write how it ended. A catalog that is away is waited for: nobody could claim anything meanwhile.

    What was done is worth more than this process; and where a COMMIT's answer was lost the stage may be ours, which
    only another try tells. A worker that is to stop does not wait.
    """
    pause = 0.1
    while True:
        try:
            with context.catalog.transaction() as tx:
                result = act(tx)
            return result
        except CatalogUnavailable as error:
            if context.stopping.is_set():
                raise
            log.warning("waiting for the catalog", reason=str(error))
        time.sleep(pause)
        pause = min(2 * pause, 5.0)


def _cancelled(context: Context, claim: workflow.Claim, cost: workflow.Cost) -> Outcome:
    _patiently(context, lambda tx: workflow.cancelled(tx, claim, cost))
    log.info("stage cancelled")
    return "cancelled"


def _released(context: Context, claim: workflow.Claim) -> Outcome:
    _patiently(context, lambda tx: workflow.release(tx, claim))
    log.info("stage given back")
    return "released"


def _failed(context: Context, claim: workflow.Claim, error: Json, cost: workflow.Cost) -> Outcome:
    cause = workflow.Cause(error["cause"])
    if cause is workflow.Cause.DISK_FULL:
        context.scratch.free()
    retry = None if cause.lasting else workflow.Retry.of(context.settings)
    _patiently(context, lambda tx: workflow.fail(tx, claim, error, retry=retry, cost=cost))
    log.warning("stage failed", reason=error["message"], cause=cause.value)
    return "failed"


def _cost(book: CostBook, done: Done | None) -> workflow.Cost:
    spent = book.stages["stage"]
    steps = done.steps if done is not None else {}
    # Steps inside reset the kernel's mark, so the highest of all is the stage's.
    peak = max([spent.peak_mb, *(mb for _, mb in steps.values())])
    return workflow.Cost(
        seconds=spent.seconds,
        cpu_seconds=spent.cpu_seconds + (done.child_cpu_seconds if done else 0.0),
        peak_mb=peak,
        scans=done.scans if done else 0,
        points=done.points if done else 0,
        bytes=done.bytes if done else 0,
        cached=done.cached if done else False,
        steps=steps,
    )


def _error(caught: Exception) -> Json:
    """What the row says about an exception that ended the stage."""
    cause = workflow.cause_of(caught)
    if isinstance(caught, TrainerLost):
        return workflow.failure(str(caught), workflow.Cause.CRASHED)
    if cause is workflow.Cause.OUT_OF_MEMORY and not isinstance(caught, L3psError):
        message = "the worker ran out of memory; use smaller scenes or a worker with more memory"
        return workflow.failure(message, cause)
    if cause is workflow.Cause.DISK_FULL:
        return workflow.failure(f"the disk is full; free some or use a larger one ({caught})", cause)
    if isinstance(caught, L3psError):
        return workflow.error_json(caught)
    log.error("stage broke", exc_info=caught)
    return workflow.failure(f"{type(caught).__name__}: {caught}", cause)
