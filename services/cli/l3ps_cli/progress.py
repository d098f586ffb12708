"""The method's progress as bars in the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from l3ps.progress import Progress
from l3ps_cli.errors import err


@contextmanager
def bars(prefix: str = "") -> Iterator[Progress]:
    """A progress callable that draws one bar a stage on standard error."""
    columns = (TextColumn("{task.description:<28}"), BarColumn(24), MofNCompleteColumn(), TimeElapsedColumn())
    with Bars(*columns, console=err) as display:
        tasks: dict[str, TaskID] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = display.add_task(f"{prefix}{stage}", total=total)
            display.update(tasks[stage], completed=done, total=total)
            if done >= total:
                display.stop_task(tasks[stage])

        yield progress
