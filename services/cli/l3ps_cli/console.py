"""How the service commands speak: results on standard output, everything else on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import typer
from l3ps.errors import InputError
from rich.console import Console

from l3ps_cli.client import ServiceProblemError, ServiceUnreachableError

out = Console()
err = Console(stderr=True)

OK, JOB_FAILED, BAD_INPUT, UNREACHABLE = 0, 1, 2, 3
"""Exit codes that scripts rely on."""


def fail(message: str, code: int) -> NoReturn:
    """End the command with one clear sentence (or several, a line each) on standard error."""
    err.print(message, style="red", markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(code)


@contextmanager
def service_errors() -> Iterator[None]:
    """Turn what can go wrong between command and service into a sentence and the exit code for it."""
    try:
        yield
    except ServiceUnreachableError as error:
        fail(str(error), UNREACHABLE)
    except ServiceProblemError as error:
        fail(str(error), BAD_INPUT)
    except InputError as error:
        fail("\n".join(str(problem) for problem in error.problems), BAD_INPUT)
