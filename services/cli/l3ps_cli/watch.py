"""The progress of a job or training in the terminal: one bar a stage, with what it is doing just now."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from l3ps_client import Client, Job, Training

_POLL_SECONDS = 0.5
Work = TypeVar("Work", bound=Mapping[str, Any])


def wait_for_job(client: Client, job_id: str, console: Console, check: Callable[[], None] | None = None) -> Job:
    """Show a job's progress until it is over; returns its last document.

    Args:
        client: the service.
        job_id: the job.
        console: where the bars go.
        check: called every half second; may raise to give up (the embedded stack's health).
    """
    jobs = client.jobs.watch(job_id, poll=_POLL_SECONDS if check else None)
    return _show_all(jobs, stages_of, console, check or (lambda: None))


def wait_for_training(client: Client, training_id: str, console: Console) -> Training:
    """Show a training's progress and figures until it is over; returns its last document."""
    return _show_all(client.trainings.watch(training_id), _stage_of_training, console, lambda: None)


def _stage_of_training(training: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    figures = " ".join(f"{name} {value:.3g}" for name, value in training["figures"].items() if _is_number(value))
    yield training["name"], training["stage"] | {"figures": figures}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _show_all(
    documents: Iterable[Work],
    stages: Callable[[Mapping[str, Any]], Iterator[tuple[str, dict[str, Any]]]],
    console: Console,
    check: Callable[[], None],
) -> Work:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[step]}", style="dim"),
    )
    with Progress(*columns, console=console) as progress:
        bars: dict[str, TaskID] = {}
        for document in documents:
            for label, stage in stages(document):
                _show(progress, bars, label, stage)
            check()
        return document


def stages_of(job: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
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
        bars[label] = progress.add_task(label, total=1.0, step="")
    step = stage["state"]
    if stage["cached"]:
        step = "from store"
    elif step == "running":
        step = f"{stage.get('step') or ''} {_units(stage)} {stage.get('figures', '')}"
    progress.update(bars[label], completed=stage["fraction"], step=step)
    if stage["state"] in ("done", "failed", "cancelled"):
        progress.stop_task(bars[label])


def _units(stage: dict[str, Any]) -> str:
    """Units of the step done and in all; too many of them are bytes, which tell a reader nothing."""
    return f"{stage['done']}/{stage['total']}" if 1 < stage["total"] < 100_000 else ""
