"""Why an attempt failed, in one word."""

import errno

import pytest

from l3ps.errors import Cancelled, DriveLogError, Problem, ProcessingError, Starved
from l3ps_platform.errors import CatalogUnavailable, LeaseLost, StoreUnavailable
from l3ps_platform.workflow.causes import Cause, cause_of, failure, stored_cause


def wrapped(outer: Exception, inner: Exception) -> Exception:
    try:
        raise outer from inner
    except Exception as error:
        return error


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (MemoryError(), Cause.OUT_OF_MEMORY),
        (RuntimeError("std::bad_alloc"), Cause.OUT_OF_MEMORY),
        (StoreUnavailable("away"), Cause.STORE_UNAVAILABLE),
        (CatalogUnavailable("away"), Cause.CATALOG_UNAVAILABLE),
        (LeaseLost("gone"), Cause.LEASE_LOST),
        (DriveLogError(Problem("c", "w", "x", "r")), Cause.BAD_INPUT),
        (ProcessingError("odometry diverged"), Cause.PROCESSING),
        (Starved("the trial was killed", "memory"), Cause.OUT_OF_MEMORY),
        (Starved("the trial had no processor", "time"), Cause.TIMEOUT),
        (Cancelled("stop"), Cause.CANCELLED),
        (ZeroDivisionError(), Cause.INTERNAL),
        (OSError(errno.EIO, "broken disk"), Cause.INTERNAL),
        (FULL, Cause.DISK_FULL),
        (wrapped(ProcessingError("there is no space left to unpack it"), FULL), Cause.DISK_FULL),
        (wrapped(StoreUnavailable("the disk failed"), FULL), Cause.DISK_FULL),
    ],
)
def test_each_failure_has_its_word(error: Exception, cause: Cause) -> None:
    assert cause_of(error) is cause


def test_what_the_world_does_to_a_stage_is_not_its_own_fault() -> None:
    environment = {cause for cause in Cause if cause.environmental}
    assert environment == {Cause.STORE_UNAVAILABLE, Cause.CATALOG_UNAVAILABLE, Cause.DISK_FULL}
    assert not any(cause.lasting for cause in environment)


def test_a_row_keeps_it() -> None:
    assert stored_cause(failure("it broke", Cause.TIMEOUT)) is Cause.TIMEOUT
    assert stored_cause({"message": "of before there were causes", "problems": []}) is Cause.INTERNAL
    assert stored_cause(None) is Cause.INTERNAL
