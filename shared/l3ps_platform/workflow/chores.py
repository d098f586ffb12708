"""What reconciler, sweeper and deliverer share: something that goes wrong keeps nothing else from its turn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from l3ps_platform.errors import CatalogUnavailable, PlatformError

log = structlog.get_logger(__name__)


class Chore:
    """Work of rounds and steps that goes on whatever happens.

    Attributes:
        name: of the thread.
        failures: how often each step, or one of the rows it was about, has failed since the process began.
    """

    def __init__(self, name: str, *steps: str) -> None:
        self.name = name
        self.failures = Counter(dict.fromkeys(steps, 0))

    @contextmanager
    def step(self, step: str) -> Iterator[None]:
        """Say and count what goes wrong inside, and bear it."""
        try:
            yield
        except PlatformError as error:  # its message says what is away
            log.warning(f"{self.name} waits", step=step, reason=str(error))
            self.failures[step] += 1
        except Exception:
            log.exception(f"{self.name} failed", step=step)
            self.failures[step] += 1

    @contextmanager
    def row(self, step: str, id: str) -> Iterator[None]:
        """The same for one of the rows of a step. CatalogUnavailable: the others would not fare better."""
        try:
            yield
        except CatalogUnavailable:
            raise
        except PlatformError as error:
            log.warning(f"{self.name} passes over", step=step, id=id, reason=str(error))
            self.failures[step] += 1
        except Exception:
            log.exception(f"{self.name} passes over", step=step, id=id)
            self.failures[step] += 1
