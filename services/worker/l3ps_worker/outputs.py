"""A stage's output: pinned in the catalog before anybody looks whether it is in the store, and looked at as a whole."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import structlog

from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.catalog import Json
from l3ps_platform.errors import CatalogUnavailable, OutputDoomed
from l3ps_platform.objects import ObjectStore
from l3ps_worker.context import Context

log = structlog.get_logger(__name__)

_PATIENCE = 30.0
"""Seconds to wait for an output that is being deleted: the sweep takes one round of the reconciler for it."""
_PAUSE = 0.5
_AT_ONCE = 8
"""Requests under way at the store: a small object costs its answer's way, tens of ms in a cloud, and hardly any bytes.
The store's client keeps so many connections."""

_In = TypeVar("_In")
_Out = TypeVar("_Out")


def pin(context: Context, claim: workflow.Claim, prefix: str, progress: Progress) -> None:
    """Keep an output for the claim's job, whoever else gives it up from now on.

    A catalog that is away is waited for, as at a stage's end: what was computed so far is worth more than the wait.

    Args:
        context, claim, progress: as a stage gets them.
        prefix: of the output's objects.

    Raises:
        OutputDoomed: it is still being deleted; a later attempt makes it anew.
        CatalogUnavailable: for as long as a stage waits for one.
        LeaseLost: the stage is no longer ours.
        Cancelled, Stopping: of ``progress``, when the stage is to end while it waits.
    """
    begun = time.monotonic()
    while True:
        try:
            with context.catalog.transaction() as tx:
                workflow.pin_output(tx, claim, prefix)
            return
        except OutputDoomed:
            if time.monotonic() > begun + _PATIENCE:
                raise
        except CatalogUnavailable as error:
            if time.monotonic() > begun + context.settings.outage_seconds:
                raise
            log.warning("output not pinned, trying again", reason=str(error))
        progress("wait", 0, 1)
        time.sleep(_PAUSE)


def is_whole(store: ObjectStore, prefix: str, files: Iterable[Json]) -> bool:
    """Whether the files that a scene's manifest names are all in the store, by name and size.

    Args:
        store: the store.
        prefix: of the output's objects.
        files: the manifest's.
    """
    found = {info.key: info.size for info in store.list(f"{prefix}/")}
    return all(found.get(file["key"]) == file["size"] for file in files)


@contextmanager
def side_by_side(act: Callable[[_In], _Out], items: Iterable[_In]) -> Iterator[Iterator[_Out]]:
    """Ask the store for many small things at once; gives the answers in the order of the items.

    Args:
        act: asks for one; runs in a thread.
        items: what it is called with.

    Whoever takes the answers meets what ``act`` raises; what has not begun when the block ends never does.
    """
    pool = ThreadPoolExecutor(_AT_ONCE)
    try:
        yield pool.map(act, items)
    finally:
        pool.shutdown(cancel_futures=True)
