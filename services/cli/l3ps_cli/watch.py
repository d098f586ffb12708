"""A job's progress in the terminal: one bar a stage, with what the method is doing just now."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from l3ps_cli.client import Client

FINAL = ("succeeded", "failed", "cancelled")
_POLL_SECONDS = 0.5


def wait_for_job(
    client: Client, job_id: str, console: Console, check: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Show a job's progress until it is over; returns its last document.

    Args:
        client: the service.
        job_id: the job.
        console: where the bars go.
        check: called between polls; may raise to give up (the embedded stack's health).
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[step]}", style="dim"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bars: dict[str, TaskID] = {}
        while True:
            job = client.get(f"/jobs/{job_id}")
            for label, stage in stages_of(job):
                _show(progress, bars, label, stage)
            if job["state"] in FINAL:
                return job
            check()
            time.sleep(_POLL_SECONDS)


def stages_of(job: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """(label, stage document) of every stage of a job, in the order in which they run."""
    own = {stage["name"]: stage for stage in job["stages"]}
    if "ingest" in own:
        yield "ingest", own["ingest"]
    for scene in job["scenes"]:
        for stage in scene["stages"]:
            yield f"{scene['name']} {stage['name']}", stage
    if "publish" in own:
        yield "publish", own["publish"]


def _show(progress: Progress, bars: dict[str, TaskID], label: str, stage: dict[str, Any]) -> None:
    if stage["state"] in ("waiting", "queued") and label not in bars:
        return
    if label not in bars:
        bars[label] = progress.add_task(label, total=None, step="")
    bar, total = bars[label], stage["total"] or None
    finished = stage["state"] in ("done", "failed", "cancelled")
    if stage["state"] == "done":
        total = total or 1
    step = stage["state"] if stage["state"] != "running" else stage.get("step") or ""
    completed = total if stage["state"] == "done" else stage["done"]
    progress.update(bar, total=total, completed=completed, step=step)
    if finished:
        progress.stop_task(bar)
