"""The worker: ``celery -A l3ps_worker.app worker -Q segment,refine -c N``."""

from __future__ import annotations

import atexit
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from l3ps_platform.settings import get_settings

settings = get_settings()
# Numeric libraries read these when they are first imported, which happens below.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ.setdefault(_name, str(settings.threads))

import cv2  # noqa: E402
import structlog  # noqa: E402
from billiard.exceptions import TimeLimitExceeded, WorkerLostError  # noqa: E402
from celery import signals  # noqa: E402

from l3ps_platform import workflow  # noqa: E402
from l3ps_platform.catalog import Catalog, StageName, stages  # noqa: E402
from l3ps_platform.errors import CatalogUnavailable, PlatformError  # noqa: E402
from l3ps_platform.processes import die_with, is_child  # noqa: E402
from l3ps_platform.queue import TASK_NAMES, Queue, make_app  # noqa: E402
from l3ps_platform.telemetry import configure_logging  # noqa: E402
from l3ps_worker import plain_words  # noqa: E402
from l3ps_worker.context import Context, StopFlag, new_worker  # noqa: E402
from l3ps_worker.pulse import Pulse  # noqa: E402
from l3ps_worker.runner import run_stage  # noqa: E402
from l3ps_worker.scratch import Scratch  # noqa: E402

log = structlog.get_logger(__name__)

app = make_app(settings)
app.conf.worker_concurrency = settings.concurrency

_stopping = StopFlag()  # made before the fork, so that the children share it
_main_pid = os.getpid()
_worker = new_worker()
_alive = ExitStack()  # holds the lock by which the worker's successor knows whether it lives
_context: Context | None = None
_NO_MEMORY = 77
"""Exit status of a child that ran out of memory."""
_NOT_RECORDED = 78
"""Exit status of a child that could not record how its stage ended."""


def context() -> Context:
    """This process' context; never inherited through a fork, because connections and sessions do not survive one."""
    global _context  # noqa: PLW0603  (one per process by design)
    if _context is None:
        _context = Context(settings, _stopping, _worker)
    return _context


def _run(stage_id: str, attempt: int) -> None:
    """The body of every task."""
    try:
        run_stage(context(), stage_id, attempt)
    except MemoryError:
        # Too little is left even to record it. Celery would take the whole worker down and see the message again.
        os._exit(_NO_MEMORY)
    except CatalogUnavailable as error:
        # The worker is told to stop while the catalog is away: the stage's lease runs out, or its message comes again.
        log.warning("stage not recorded", stage=stage_id, reason=str(error))
    except Exception:
        # The row may say that this process is at work on the stage, and while it lives the pulse prolongs its lease.
        log.exception("stage not recorded, this process ends", stage=stage_id)
        os._exit(_NOT_RECORDED)


for _stage, _task_name in TASK_NAMES.items():
    _seconds = settings.train_seconds if _stage is StageName.TRAIN else settings.stage_seconds
    app.task(name=_task_name, time_limit=_seconds)(_run)


signals.celeryd_init.connect(plain_words.make_lines, weak=False)


@signals.setup_logging.connect  # type: ignore[untyped-decorator]
def _configure_logging(**_: Any) -> None:
    configure_logging(settings, "worker")


@signals.worker_process_init.connect  # type: ignore[untyped-decorator]
def _after_fork(**_: Any) -> None:
    global _context  # noqa: PLW0603
    _context = None
    die_with(_main_pid)
    os.nice(settings.nice)
    cv2.setNumThreads(settings.threads)


@signals.worker_shutting_down.connect  # type: ignore[untyped-decorator]
def _give_back(**_: Any) -> None:
    """A stage may take minutes; a worker that is told to stop should not."""
    _stopping.set()


@signals.task_failure.connect  # type: ignore[untyped-decorator]
def _child_lost(args: Any = None, exception: BaseException | None = None, **_: Any) -> None:
    """In the main process: a child was killed, by the kernel for memory or by the time limit.

    Its lease would run out anyway; saying so now saves the wait and gives the reason.
    """
    if not isinstance(exception, WorkerLostError | TimeLimitExceeded) or not args:
        return
    reason, cause = _ending(exception)
    log.warning("child lost", stage=args[0], reason=reason, cause=cause.value)
    retry = workflow.Retry.of(settings)
    with _briefly() as catalog, catalog.transaction() as tx:
        for stage_id, owner in stages.owned(tx.session, _worker):
            # Given back before the child died, the stage may be in the hands of another one by now. A child beyond
            # the time limit is reported first and then killed.
            dead = isinstance(exception, TimeLimitExceeded) or not is_child(int(owner.rpartition(":")[2]), _main_pid)
            if stage_id == args[0] and dead:
                workflow.lease_lost(tx, stage_id, retry, owner_prefix=owner, reason=reason, cause=cause)


def _ending(error: WorkerLostError | TimeLimitExceeded) -> tuple[str, workflow.Cause]:
    """What befell a child, for the user and in one word."""
    if isinstance(error, TimeLimitExceeded):
        known = error.args and isinstance(error.args[0], int | float)
        limit = float(error.args[0]) if known else settings.stage_seconds
        return f"it ran for more than {limit:.0f} s and was stopped", workflow.Cause.TIMEOUT
    how = re.search(r"signal \d+ \((\w+)\)|exitcode (-?\d+)", str(error))
    signal, status = how.groups() if how else (None, None)
    if status == str(_NO_MEMORY) or (signal == "SIGKILL" and _killed_for_memory()):
        return "its worker process ran out of memory; use smaller scenes or more memory", workflow.Cause.OUT_OF_MEMORY
    ending = f"was killed by {signal}" if signal else f"ended with status {status}" if status else "ended"
    return f"its worker process {ending} in mid-stage", workflow.Cause.CRASHED


def _killed_for_memory() -> bool:
    """Whether the kernel has killed a process for memory since this was last asked, in our control group or at all."""
    global _memory_kills
    before, _memory_kills = _memory_kills, _count_memory_kills()
    return _memory_kills > before


def _count_memory_kills() -> int:
    for path in (Path("/sys/fs/cgroup/memory.events"), Path("/proc/vmstat")):
        with suppress(OSError):
            found = re.search(r"^oom_kill (\d+)$", path.read_text(), re.MULTILINE)
            if found:
                return int(found[1])
    return 0


_memory_kills = _count_memory_kills()


@signals.worker_init.connect  # type: ignore[untyped-decorator]
def _begin(**_: Any) -> None:
    """In the main process at its start, before the fork: arrange for the end, start the pulse, bury predecessors.

    What a worker held that was killed on this machine is free at once.
    """
    atexit.register(Pulse(_worker).stop)
    atexit.register(_give_back_rest)  # the signal worker_shutdown is not sent when SIGQUIT ends the worker
    scratch = Scratch(settings.scratch, settings.scratch_bytes)
    scratch.sweep()
    _alive.enter_context(scratch.alive(_worker))
    retry = workflow.Retry.of(settings)
    with _briefly() as catalog:
        for dead in scratch.dead_workers():
            with catalog.reading() as session:
                left = stages.owned(session, dead)
            for stage_id, owner in left:
                with catalog.transaction() as tx:
                    workflow.lease_lost(tx, stage_id, retry, owner_prefix=owner)


def _give_back_rest() -> None:
    """In the main process at its end: what a child held that was killed in mid-stage by our own shutdown."""
    if os.getpid() != _main_pid:
        return
    with _briefly() as catalog:
        workflow.release_owned(catalog, _worker)


@contextmanager
def _briefly() -> Iterator[Catalog]:
    """A catalog of the main process, whose connections no child may inherit: opened and closed again at once.

    A catalog that is away is logged only: leases run out.
    """
    queue = Queue(settings)
    catalog = Catalog(settings.catalog_url, queue.send)
    try:
        yield catalog
    except PlatformError as error:
        log.warning("leases will run out", reason=str(error))
    finally:
        catalog.dispose()
        queue.close()
