"""How commands speak: results on standard output, everything else on standard error; and how they end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import typer
from rich.console import Console

from l3ps.errors import Cancelled, InputError, L3psError

out = Console()
err = Console(stderr=True)

OK, FAILED, BAD_INPUT, UNREACHABLE = 0, 1, 2, 3
"""Exit codes that scripts rely on."""
INTERRUPTED = 130


def fail(message: str, code: int) -> NoReturn:
    """End the command with one clear sentence (or several, a line each) on standard error."""
    err.print(message, style="red", markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(code)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn the project's own errors, and a Ctrl-C, into sentences and exit codes; anything else is a defect."""
    try:
        yield
    except InputError as error:
        fail("\n".join(str(problem) for problem in error.problems), BAD_INPUT)
    except (Cancelled, KeyboardInterrupt):
        fail("Stopped; nothing was written.", INTERRUPTED)
    except L3psError as error:
        fail(str(error), FAILED)
    except OSError as error:
        if error.filename is None:
            raise
        fail(f"{error.filename}: {error.strerror}. Name a place that exists and that you may use.", BAD_INPUT)


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end the block as Ctrl-C does, so that it tidies up."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
