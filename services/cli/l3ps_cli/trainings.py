"""``l3ps trainings``: the models that the service trains, or one training in full."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import quote

import typer
from rich.table import Table

from l3ps_cli.client import Client
from l3ps_cli.console import out, service_errors
from l3ps_cli.jobs import COLORS


def trainings(
    training: Annotated[str | None, typer.Argument(help="Show this training in full.", show_default=False)] = None,
    limit: Annotated[int, typer.Option(min=1, max=200, help="How many, newest first.")] = 20,
    state: Annotated[str | None, typer.Option(help="Only trainings in this state.", show_default=False)] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the training.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the service's document.")] = False,
) -> None:
    """List the service's trainings, newest first; with an id, show that training and its log, or cancel it."""
    if cancel and not training:
        raise typer.BadParameter("--cancel needs the id of a training")
    with service_errors(), Client() as client:
        path = f"/trainings/{quote(training, safe='')}" if training else "/trainings"
        if cancel:
            document = client.post(f"{path}/cancel")
        else:
            document = client.get(path) if training else client.get(path, limit=limit, state=state)
    if as_json:
        out.print_json(data=document)
    elif training:
        _show(document)
    else:
        _list(document["items"])


def _list(documents: list[dict[str, Any]]) -> None:
    if not documents:
        out.print("No trainings yet: `l3ps submit-training ANNOTATIONS --name NAME --backbone NAME` makes one.")
        return
    table = Table(box=None)
    table.add_column("training", min_width=29, no_wrap=True)  # an id is for copying, so it is never cut short
    for name in ("model", "backbone", "annotations", "state", "done", "figures"):
        table.add_column(name)
    for one in documents:
        state = f"[{COLORS.get(one['state'], 'white')}]{one['state']}[/]"
        row = (one["name"], one["settings"]["backbone"], one["annotations"]["name"], state)
        table.add_row(one["id"], *row, f"{100 * one['progress']:.0f} %", _figures(one))
    out.print(table)


def _show(training: dict[str, Any]) -> None:
    out.print(f"{training['id']}: {training['state']}, {100 * training['progress']:.0f} % done", highlight=False)
    what = f"{training['name']} from {training['annotations']['name']} over {training['settings']['backbone']}"
    out.print(what, markup=False, highlight=False)
    for problem in training.get("errors") or []:
        out.print(f"  {problem['where']}: {problem['what']}. {problem['remedy']}", style="red", markup=False)
    if training.get("message") and not training.get("errors"):
        out.print(f"  {training['message']}", style="red", markup=False)
    if training["figures"]:
        out.print(_figures(training), highlight=False)
    if training["log"]:
        out.print(training["log"], style="dim", markup=False, highlight=False, soft_wrap=True, end="")


def _figures(training: dict[str, Any]) -> str:
    numbers = {name: value for name, value in training["figures"].items() if isinstance(value, int | float)}
    return ", ".join(f"{name} {value:.3g}" for name, value in numbers.items())
