"""The worker: ``celery -A l3ps_worker.app worker -Q segment,refine -c N``."""

from __future__ import annotations

import atexit
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
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
from l3ps_platform.errors import PlatformError  # noqa: E402
from l3ps_platform.processes import die_with  # noqa: E402
from l3ps_platform.queue import TASK_NAMES, Queue, make_app  # noqa: E402
from l3ps_platform.telemetry import configure_logging  # noqa: E402
from l3ps_worker import plain_words  # noqa: E402
from l3ps_worker.context import Context, StopFlag, owner_prefix  # noqa: E402
from l3ps_worker.pulse import Pulse  # noqa: E402
from l3ps_worker.runner import run_stage  # noqa: E402

log = structlog.get_logger(__name__)

app = make_app(settings)
app.conf.worker_concurrency = settings.concurrency

_stopping = StopFlag()  # made before the fork, so that the children share it
_main_pid = os.getpid()
_context: Context | None = None


def context() -> Context:
    """This process' context; never inherited through a fork, because connections and sessions do not survive one."""
    global _context  # noqa: PLW0603  (one per process by design)
    if _context is None:
        _context = Context(settings, _stopping, _main_pid)
    return _context


def _run(stage_id: str, attempt: int) -> None:
    """The body of every task."""
    try:
        run_stage(context(), stage_id, attempt)
    except PlatformError as error:
        # The catalog is away. The message is spent; the reconciler sends another when the row still says queued.
        log.warning("stage not recorded", stage=stage_id, reason=str(error))


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
    if isinstance(exception, TimeLimitExceeded):
        reason = f"it ran for more than {_limit(exception):.0f} s and was stopped"
    else:
        reason = "its worker process was killed, most likely for using too much memory"
    log.warning("child lost", stage=args[0], reason=reason)
    retry = workflow.Retry(settings.max_attempts, settings.retry_seconds)
    with _briefly() as tx:
        workflow.lease_lost(tx, args[0], retry, owner_prefix=owner_prefix(_main_pid), reason=reason)


def _limit(error: TimeLimitExceeded) -> float:
    """The seconds that were too many."""
    return float(error.args[0]) if error.args and isinstance(error.args[0], int | float) else settings.stage_seconds


@signals.worker_init.connect  # type: ignore[untyped-decorator]
def _begin(**_: Any) -> None:
    """In the main process at its start, before the fork: arrange for the end, start the pulse, bury predecessors.

    What a worker held that was killed on this machine is free at once.
    """
    atexit.register(Pulse(owner_prefix(_main_pid)).stop)
    atexit.register(_give_back_rest)  # the signal worker_shutdown is not sent when SIGQUIT ends the worker
    retry = workflow.Retry(settings.max_attempts, settings.retry_seconds)
    with _briefly() as tx:
        for stage_id, owner in stages.owned(tx.session, f"{socket.gethostname()}:"):
            pid = owner.split(":")[-2]
            if int(pid) == _main_pid or not Path("/proc", pid).exists():
                workflow.lease_lost(tx, stage_id, retry, owner_prefix=owner)


def _give_back_rest() -> None:
    """In the main process at its end: what a child held that was killed in mid-stage by our own shutdown."""
    if os.getpid() != _main_pid:
        return
    with _briefly() as tx:
        workflow.release_owned(tx, owner_prefix(_main_pid))


@contextmanager
def _briefly() -> Iterator[workflow.Transaction]:
    """A transaction of the main process, on connections that no child may inherit: opened and closed again at once.

    A catalog that is away is logged only: leases run out.
    """
    queue = Queue(settings)
    catalog = Catalog(settings.catalog_url, queue.send)
    try:
        with catalog.transaction() as tx:
            yield tx
    except PlatformError as error:
        log.warning("leases will run out", reason=str(error))
    finally:
        catalog.dispose()
        queue.close()
