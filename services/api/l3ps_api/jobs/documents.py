"""Documents of jobs as they were sent last, kept for as long as nothing changes.

Whoever waits for a job asks for it again and again, and mostly nothing has changed: one query tells
(:func:`l3ps_platform.catalog.jobs.revision`), where the document takes several and half of its time is spent on turning
it into JSON. The query is made every time, so nothing is ever older than the catalog.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

KEPT_BYTES = 32 << 20
"""A job of one scene has 4 kB, one of 850 scenes 2 MB."""


class Documents:
    """Encoded documents by id, each with the revision it shows; the least recently asked go first."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._known: OrderedDict[str, tuple[tuple[Any, ...], bytes]] = OrderedDict()
        self._size = 0
        self._lock = threading.Lock()

    def get(self, id: str, revision: tuple[Any, ...], make: Callable[[], bytes]) -> bytes:
        """The document at this revision; ``make`` is called for one that is not known."""
        with self._lock:
            known = self._known.get(id)
            if known is not None and known[0] == revision:
                self._known.move_to_end(id)
                return known[1]
        body = make()
        with self._lock:
            self._drop(id)
            self._known[id] = revision, body
            self._size += len(body)
            while self._size > self._kept_bytes:
                self._drop(next(iter(self._known)))
        return body

    def _drop(self, id: str) -> None:
        known = self._known.pop(id, None)
        if known is not None:
            self._size -= len(known[1])
