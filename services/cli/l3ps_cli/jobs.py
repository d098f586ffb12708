"""``l3ps jobs``: what the service works on, or one job in full."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import quote

import typer
from rich.table import Table

from l3ps_cli.client import Client
from l3ps_cli.console import out, service_errors
from l3ps_cli.report import quality_table, stage_table

COLORS = {"succeeded": "green", "failed": "red", "cancelled": "yellow", "running": "cyan"}


def jobs(
    job: Annotated[str | None, typer.Argument(help="Show this job in full.", show_default=False)] = None,
    limit: Annotated[int, typer.Option(min=1, max=200, help="How many, newest first.")] = 20,
    state: Annotated[str | None, typer.Option(help="Only jobs in this state.", show_default=False)] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the job.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the service's document.")] = False,
) -> None:
    """List the service's jobs, newest first; with an id, show that job, or cancel it."""
    if cancel and not job:
        raise typer.BadParameter("--cancel needs the id of a job")
    with service_errors(), Client() as client:
        if job and cancel:
            document = client.post(f"/jobs/{quote(job, safe='')}/cancel")
        else:
            document = (
                client.get(f"/jobs/{quote(job, safe='')}") if job else client.get("/jobs", limit=limit, state=state)
            )
    if as_json:
        out.print_json(data=document)
    elif job:
        _show(document)
    else:
        _list(document["items"])


def _list(documents: list[dict[str, Any]]) -> None:
    if not documents:
        out.print("No jobs yet: `l3ps submit LOG --model NAME` makes one.")
        return
    table = Table(box=None)
    table.add_column("job", min_width=29, no_wrap=True)  # an id is for copying, so it is never cut short
    for name in ("drive", "model", "preset", "state", "done", "PQ"):
        table.add_column(name)
    for job in documents:
        refined = (job.get("quality") or {}).get("refined") or {}
        table.add_row(
            job["id"],
            job["drive"]["name"],
            job["model"]["name"],
            job["preset"],
            f"[{COLORS.get(job['state'], 'white')}]{job['state']}[/]",
            f"{100 * job['progress']:.0f} %",
            f"{refined['pq']:.1f}" if refined else "",
        )
    out.print(table)


def _show(job: dict[str, Any]) -> None:
    out.print(f"{job['id']}: {job['state']}, {100 * job['progress']:.0f} % done", highlight=False)
    ways = f"preset {job['preset']}, segment {job['segment']}"
    out.print(f"{job['drive']['name']} with {job['model']['name']}, {ways}", highlight=False)
    for problem in job.get("errors") or []:
        out.print(f"  {problem['where']}: {problem['what']}. {problem['remedy']}", style="red", markup=False)
    out.print(stage_table(job))
    if job.get("quality"):
        out.print(quality_table(job["quality"]))
