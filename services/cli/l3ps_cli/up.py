"""``l3ps up``: the whole service on this machine, in one directory, until Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from l3ps_cli.console import JOB_FAILED, err, fail, out
from l3ps_cli.errors import clear_errors
from l3ps_cli.processes import ChildDiedError
from l3ps_cli.stack import Stack, StackError, StackOptions

DEFAULT_DATA = Path("~/.local/share/l3ps")


class StopRequested(BaseException):
    """Ctrl-C or SIGTERM."""


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Raise StopRequested in the main thread at the first SIGINT, SIGTERM or SIGHUP.

    Later ones are ignored: stopping has its deadlines, and an interrupted clean-up would leave something behind.
    """
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def request(number: int, _frame: FrameType | None) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_IGN)
        raise StopRequested(signal.Signals(number).name)

    before = {each: signal.signal(each, request) for each in signals}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def up(
    *,
    data: Annotated[
        Path, typer.Option(help="Directory that holds everything.", envvar="L3PS_DATA_DIR", file_okay=False)
    ] = DEFAULT_DATA,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the API on 127.0.0.1; 0 takes any free one.")
    ] = 8080,
    workers: Annotated[int, typer.Option(min=0, help="Worker processes; 0 for one per two cores.")] = 0,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads each worker process may use.")] = 2,
    token: Annotated[
        str | None,
        typer.Option(
            help="The operator's token; default: the one in DATA/token, made at the first start.",
            envvar="L3PS_TOKEN",
            show_default=False,
        ),
    ] = None,
    no_token: Annotated[
        bool, typer.Option("--no-token", help="Ask for none: whoever is on this machine may use it.")
    ] = False,
    logs: Annotated[bool, typer.Option("--logs", help="Show what the services log.")] = False,
) -> None:
    """Run the service on this machine: Redis, API and workers, all data in one directory. Ctrl-C stops it."""
    count = workers or max(1, (os.cpu_count() or 1) // threads)
    options = StackOptions(data.expanduser(), port, count, threads, token or None, open=no_token, training=True)
    try:
        with stop_on_signals(), clear_errors(), Stack(options, lambda step: err.print(f"[dim]{step}[/dim]")) as stack:
            out.print(f"l3ps is up at {stack.url}  (data: {stack.data}, logs: {stack.logs})", highlight=False)
            out.print(_access(stack), markup=False, highlight=False, soft_wrap=True)
            out.print("Ctrl-C stops it.")
            follow = _Follower(stack.logs) if logs else None
            while True:
                stack.check()
                if follow:
                    follow.show()
                time.sleep(0.3)
    except StopRequested:
        out.print("l3ps has stopped.")
    except ChildDiedError as error:
        fail(f"{error}. Everything else was stopped too. Its last lines:\n{error.last_lines}", JOB_FAILED)
    except (StackError, TimeoutError) as error:
        fail(str(error), JOB_FAILED)


def _access(stack: Stack) -> str:
    """How to get in: to paste, where a person reads it; without the secret, where it may end in a log."""
    if stack.token is None:
        return "It asks for no token: whoever is on this machine may use it."
    if sys.stdout.isatty():
        return f"Commands on this machine find it. Elsewhere: export L3PS_URL={stack.url} L3PS_TOKEN={stack.token}"
    return f"Commands on this machine find it by {stack.data / 'up.json'}, which holds its token."


class _Follower:
    """Shows what is appended to the log files, each line behind its service's name."""

    def __init__(self, logs: Path) -> None:
        self._files = {path.stem: path.open("r", errors="replace") for path in sorted(logs.glob("*.log"))}
        for file in self._files.values():
            file.seek(0, os.SEEK_END)

    def show(self) -> None:
        for name, file in self._files.items():
            for line in file.read().splitlines():
                out.print(f"{name:>6} | {line}", markup=False, highlight=False, soft_wrap=True)
