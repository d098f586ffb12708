"""A sha256 that is computed beside the transfer it belongs to."""

from __future__ import annotations

import hashlib
from concurrent.futures import Future, ThreadPoolExecutor

_WORTH_A_THREAD = 1 << 18


class Digest:
    """A sha256; one large block can be on its way through it while the next is being received."""

    def __init__(self) -> None:
        self._sha256 = hashlib.sha256()
        self._pool: ThreadPoolExecutor | None = None
        self._running: Future[None] | None = None

    def update(self, block: bytes) -> None:
        """Add a block."""
        self._settle()
        self._sha256.update(block)

    def update_beside(self, block: bytes) -> None:
        """Add a block, in another thread where it is large; at most one is under way."""
        if len(block) < _WORTH_A_THREAD:
            self.update(block)
            return
        self._settle()
        self._pool = self._pool or ThreadPoolExecutor(1)
        self._running = self._pool.submit(self._sha256.update, block)

    def hexdigest(self) -> str:
        """The digest of all that was added."""
        self._settle()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        return self._sha256.hexdigest()

    def _settle(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.result()
