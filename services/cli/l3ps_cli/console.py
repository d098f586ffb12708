"""How commands that talk to a service speak and end: sentences, exit codes, tables and JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
from rich.table import Table

from l3ps_cli.errors import BAD_INPUT, INTERRUPTED, OK, UNREACHABLE, clear_errors, err, fail, out
from l3ps_cli.errors import FAILED as JOB_FAILED
from l3ps_client import L3psClientError, Refused, TooManyRequests, Unreachable
from l3ps_client import Progress as Report

__all__ = [
    "BAD_INPUT", "JOB_FAILED", "OK", "UNREACHABLE", "AsJson", "Limit", "Report", "bytes_bar", "done", "err", "fail",
    "out", "print_items", "service_errors", "state",
]  # fmt: skip

AsJson = Annotated[bool, typer.Option("--json", help="Print the service's document.")]
Limit = Annotated[int, typer.Option(min=1, max=200, help="How many, newest first.")]

_COLORS = {"succeeded": "green", "ready": "green", "failed": "red", "rejected": "red", "cancelled": "yellow"} | {
    "running": "cyan", "open": "cyan",
}  # fmt: skip


@contextmanager
def service_errors() -> Iterator[None]:
    """Turn what can go wrong between command and service into a sentence and the exit code for it."""
    with clear_errors():
        try:
            yield
        except (Unreachable, TooManyRequests) as error:
            fail(str(error), UNREACHABLE)
        except Refused as error:
            fail(str(error), BAD_INPUT)
        except KeyboardInterrupt:
            fail("Stopped. The same command goes on where this one was.", INTERRUPTED)
        except L3psClientError as error:
            fail(str(error), JOB_FAILED)


def state(name: str) -> str:
    """A state in its colour."""
    return f"[{_COLORS.get(name, 'white')}]{name}[/]"


def print_items(
    page: Mapping[str, Any], columns: Mapping[str, Callable[[Any], str]], *, as_json: bool, nothing: str
) -> None:
    """A page of documents as a table, or as it came.

    Args:
        page: with ``items``.
        columns: what each column says of an item, by its title; the first is an id, which is never cut short.
        as_json: print the page itself.
        nothing: the sentence for a page without items.
    """
    if as_json:
        out.print_json(data=page)
        return
    if not page["items"]:
        out.print(nothing)
        return
    table = Table(box=None)
    for position, title in enumerate(columns):
        table.add_column(title, min_width=29 if position == 0 else None, no_wrap=position == 0)
    for item in page["items"]:
        table.add_row(*(say(item) for say in columns.values()))
    out.print(table)


def done(sentence: str, document: Mapping[str, Any] | None = None, *, as_json: bool) -> None:
    """Say what was done, or print the document of it."""
    if as_json:
        out.print_json(data=document or {})
    else:
        out.print(sentence, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def bytes_bar(what: str, total: int | None = None) -> Iterator[Report]:
    """A bar of bytes on standard error, moved by (done, total); a total of 0 is one that nobody knows."""
    columns = (TextColumn("{task.description:<20}"), BarColumn(24), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=err) as progress:
        bar = progress.add_task(what, total=total)
        yield lambda done, whole: progress.update(bar, completed=done, total=whole or None)


def items_of(found: Iterable[Any]) -> dict[str, Any]:
    """Documents that came without a page around them, as one."""
    return {"items": [*found], "next": None}
