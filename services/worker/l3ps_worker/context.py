"""What a worker process holds: settings, connections and caches, made after the fork."""

from __future__ import annotations

import mmap
import os
import secrets
import socket
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

from l3ps.segment.bundle import ModelBundle
from l3ps.segment.presets import SegmentPreset
from l3ps.segment.session import Segmenter
from l3ps_platform.catalog import Catalog
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings
from l3ps_worker.scratch import Scratch

SESSIONS_KEPT = 2
"""ONNX sessions a process keeps: a job's scenes use one model; a second covers two jobs in turn."""


class StopFlag:
    """One byte that a worker's main process shares with the children it forks: set means "give back what you hold"."""

    def __init__(self) -> None:
        self._page = mmap.mmap(-1, 1)

    def set(self) -> None:
        """Ask all children to stop at their next report."""
        self._page[0] = 1

    def is_set(self) -> bool:
        """Whether the worker is stopping."""
        return self._page[0] != 0


class Context:
    """A worker process' tools.

    Args:
        settings: the service's settings.
        stopping: set when the worker is to stop.
        worker: how the names of the worker's owners of leases begin.
    """

    def __init__(self, settings: Settings, stopping: StopFlag | None = None, worker: str | None = None) -> None:
        self.settings = settings
        self.stopping = stopping or StopFlag()
        self.queue = Queue(settings)
        self.catalog = Catalog(settings.catalog_url, self.queue.send)
        self.store: ObjectStore = open_store(settings)
        self.scratch = Scratch(settings.scratch, settings.scratch_bytes)
        self.owner = f"{worker or new_worker()}{os.getpid()}"
        self._segmenters: OrderedDict[tuple[str, float, SegmentPreset], Segmenter] = OrderedDict()

    def segmenter(self, sha256: str, bundle: Path, min_area: float, look: SegmentPreset) -> Segmenter:
        """A session for the bundle, kept for the next scene."""
        key = (sha256, min_area, look)
        if key not in self._segmenters:
            while len(self._segmenters) >= SESSIONS_KEPT:
                self._segmenters.popitem(last=False)
            self._segmenters[key] = Segmenter(ModelBundle.load(bundle), self.settings.threads, min_area, look)
        self._segmenters.move_to_end(key)
        return self._segmenters[key]

    def close(self) -> None:
        """Close all connections."""
        self.catalog.dispose()
        with suppress(Exception):
            self.queue.close()


def new_worker() -> str:
    """How the names of all owners of leases below this main process begin: never the same twice.

    A container that starts again has the host name and the process ids of before, and a neighbour may have them too:
    the pulse would go on to prolong what they held.
    """
    return f"{socket.gethostname()}:{os.getpid()}:{secrets.token_hex(4)}:"
