"""What can go wrong between command and service, as sentences and exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from l3ps_cli.client import ServiceProblemError, ServiceUnreachableError
from l3ps_cli.errors import BAD_INPUT, OK, UNREACHABLE, clear_errors, err, fail, out
from l3ps_cli.errors import FAILED as JOB_FAILED

__all__ = ["BAD_INPUT", "JOB_FAILED", "OK", "UNREACHABLE", "err", "fail", "out", "service_errors"]


@contextmanager
def service_errors() -> Iterator[None]:
    """Turn what can go wrong between command and service into a sentence and the exit code for it."""
    with clear_errors():
        try:
            yield
        except ServiceUnreachableError as error:
            fail(str(error), UNREACHABLE)
        except ServiceProblemError as error:
            fail(str(error), BAD_INPUT)
