"""Why an attempt failed, in one word: it decides whether and when a stage is tried again, and the figures count it."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from enum import StrEnum

from l3ps.errors import Cancelled, InputError, ProcessingError, Starved
from l3ps_platform.catalog.base import Json
from l3ps_platform.errors import CatalogUnavailable, LeaseLost, QueueUnavailable, StoreUnavailable


class Cause(StrEnum):
    """Causes of failed attempts, as ``stage.error["cause"]`` and the metrics spell them."""

    CRASHED = "crashed"
    OUT_OF_MEMORY = "out-of-memory"
    LEASE_LOST = "lease-lost"
    TIMEOUT = "timeout"
    STORE_UNAVAILABLE = "store-unavailable"
    CATALOG_UNAVAILABLE = "catalog-unavailable"
    DISK_FULL = "disk-full"
    BAD_INPUT = "bad-input"
    PROCESSING = "processing"
    CANCELLED = "cancelled"
    INTERNAL = "internal"

    @property
    def environmental(self) -> bool:
        """Whether what the stage stands on failed and not the stage: such failures use up no attempt, but time."""
        return self in _ENVIRONMENT

    @property
    def lasting(self) -> bool:
        """Whether the same input fails the same way, so that another try is for nothing."""
        return self in (Cause.BAD_INPUT, Cause.PROCESSING, Cause.CANCELLED)


_ENVIRONMENT = (Cause.STORE_UNAVAILABLE, Cause.CATALOG_UNAVAILABLE, Cause.DISK_FULL)

# What compiled code says when memory is short, where it raises its own kind of error: ONNX Runtime, C++, OpenCV.
_NO_MEMORY = ("Failed to allocate memory", "bad_alloc", "Insufficient memory")

_BY_TYPE: tuple[tuple[type[BaseException] | tuple[type[BaseException], ...], Cause], ...] = (
    (MemoryError, Cause.OUT_OF_MEMORY),
    ((StoreUnavailable, QueueUnavailable), Cause.STORE_UNAVAILABLE),
    (CatalogUnavailable, Cause.CATALOG_UNAVAILABLE),
    (LeaseLost, Cause.LEASE_LOST),
    (InputError, Cause.BAD_INPUT),
    (ProcessingError, Cause.PROCESSING),
    (Cancelled, Cause.CANCELLED),
)


def cause_of(error: BaseException) -> Cause:
    """The cause behind an exception. A full disk counts whatever it is wrapped in."""
    if disk_is_full(error):
        return Cause.DISK_FULL
    if isinstance(error, Starved):
        return Cause.OUT_OF_MEMORY if error.lack == "memory" else Cause.TIMEOUT
    for kind, cause in _BY_TYPE:
        if isinstance(error, kind):
            return cause
    return Cause.OUT_OF_MEMORY if any(words in str(error) for words in _NO_MEMORY) else Cause.INTERNAL


def disk_is_full(error: BaseException) -> bool:
    """Whether an exception comes from a disk, or a quota, without space."""
    return any(isinstance(e, OSError) and e.errno in (errno.ENOSPC, errno.EDQUOT) for e in _chain(error))


def failure(message: str, cause: Cause) -> Json:
    """An error as rows keep it."""
    return {"message": message, "problems": [], "cause": cause.value}


def stored_cause(error: Json | None) -> Cause:
    """The cause that a row keeps; rows of before there were causes have none."""
    return Cause((error or {}).get("cause", Cause.INTERNAL))


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and what it was raised from."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
