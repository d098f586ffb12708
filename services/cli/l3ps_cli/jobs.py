"""``l3ps jobs``: what the service works on, or one job in full."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from l3ps_cli.console import AsJson, Limit, done, err, fail, out, print_items, service_errors, state
from l3ps_cli.errors import INTERRUPTED
from l3ps_cli.report import quality_table, stage_table
from l3ps_cli.submit import require_success
from l3ps_cli.watch import wait_for_job
from l3ps_client import Client, Job


def jobs(
    job: Annotated[str | None, typer.Argument(help="Show this job in full.", show_default=False)] = None,
    *,
    limit: Limit = 20,
    only: Annotated[str | None, typer.Option("--state", help="Only jobs in this state.", show_default=False)] = None,
    drive: Annotated[str | None, typer.Option(help="Only jobs on this drive, by its id.", show_default=False)] = None,
    model: Annotated[str | None, typer.Option(help="Only jobs with this model, by its id.", show_default=False)] = None,
    after: Annotated[str | None, typer.Option(help="Only jobs made after this time (ISO 8601).")] = None,
    before: Annotated[str | None, typer.Option(help="Only jobs made before this time (ISO 8601).")] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the job.")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Run again what is missing of the job.")] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the finished job's labels.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="Show the job's progress until it is over.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the service's jobs, newest first; with an id, show that job, follow, cancel, retry or delete it."""
    act = one_of("job", job, cancel=cancel, retry=retry, delete=delete, follow=follow)
    with service_errors(), Client() as client:
        if job is None:
            filters = {"state": only, "drive_id": drive, "model_id": model}
            filters |= {"created_after": after, "created_before": before}
            page = client.jobs.page(limit=limit, **filters)
            nothing = "No jobs yet: `l3ps submit LOG --model NAME` makes one."
            print_items(page, COLUMNS, as_json=as_json, nothing=nothing)
        elif act == "delete":
            client.jobs.delete(job)
            done(f"The labels of job {job} are deleted.", {"id": job, "deleted": True}, as_json=as_json)
        elif act == "follow":
            _follow(client, job, as_json)
        else:
            document = {"cancel": client.jobs.cancel, "retry": client.jobs.retry}.get(act, client.jobs.get)(job)
            _print(document, as_json)


def one_of(kind: str, named: str | None, **asked: bool) -> str:
    """The one thing that a command is asked to do with what is named, empty for none; else a usage error."""
    acts = [name for name, wanted in asked.items() if wanted]
    options = " and ".join(f"--{name}" for name in acts)
    if acts and named is None:
        raise typer.BadParameter(f"{options} needs the id of a {kind}")
    if len(acts) > 1:
        raise typer.BadParameter(f"{options} do not go together")
    return acts[0] if acts else ""


def _follow(client: Client, job: str, as_json: bool) -> None:
    try:
        document = wait_for_job(client, job, err)
    except KeyboardInterrupt:
        fail(f"Job {job} goes on; `l3ps jobs {job} --cancel` stops it.", INTERRUPTED)
    _print(document, as_json)
    require_success(document)


def _print(job: Job, as_json: bool) -> None:
    if as_json:
        out.print_json(data=job)
        return
    out.print(f"{job['id']}: {job['state']}, {100 * job['progress']:.0f} % done", highlight=False)
    ways = f"preset {job['preset']}, segment {job['segment']}"
    out.print(f"{job['drive']['name']} with {job['model']['name']}, {ways}", markup=False, highlight=False)
    for problem in job.get("errors") or []:
        out.print(f"  {problem['where']}: {problem['what']}. {problem['remedy']}", style="red", markup=False)
    out.print(stage_table(job))
    if job.get("quality"):
        out.print(quality_table(job["quality"] or {}))


def _quality(job: Any) -> str:
    refined = (job.get("quality") or {}).get("refined") or {}
    return f"{refined['pq']:.1f}" if refined.get("pq") is not None else ""


COLUMNS = {
    "job": lambda job: job["id"],
    "drive": lambda job: job["drive"]["name"],
    "model": lambda job: job["model"]["name"],
    "preset": lambda job: job["preset"],
    "state": lambda job: state(job["state"]),
    "done": lambda job: f"{100 * job['progress']:.0f} %",
    "PQ": _quality,
}
