"""``l3ps trainings``: the models that the service trains, or one training in full."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from l3ps_cli.console import AsJson, Limit, out, print_items, service_errors, state
from l3ps_cli.jobs import one_of
from l3ps_client import Client, Training


def trainings(
    training: Annotated[str | None, typer.Argument(help="Show this training in full.", show_default=False)] = None,
    limit: Limit = 20,
    only: Annotated[
        str | None, typer.Option("--state", help="Only trainings in this state.", show_default=False)
    ] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the training.")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Go on with it from its last checkpoint.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the service's trainings, newest first; with an id, show that training and its log, cancel or retry it."""
    act = one_of("training", training, cancel=cancel, retry=retry)
    with service_errors(), Client() as client:
        if training is None:
            page = client.trainings.page(limit=limit, state=only)
            nothing = "No trainings yet: `l3ps submit-training ANNOTATIONS --name NAME --backbone NAME` makes one."
            print_items(page, COLUMNS, as_json=as_json, nothing=nothing)
        else:
            acts = {"cancel": client.trainings.cancel, "retry": client.trainings.retry}
            _print(acts.get(act, client.trainings.get)(training), as_json)


def _print(training: Training, as_json: bool) -> None:
    if as_json:
        out.print_json(data=training)
        return
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


def _figures(training: Any) -> str:
    numbers = {name: value for name, value in training["figures"].items() if isinstance(value, int | float)}
    return ", ".join(f"{name} {value:.3g}" for name, value in numbers.items())


COLUMNS = {
    "training": lambda training: training["id"],
    "model": lambda training: training["name"],
    "backbone": lambda training: training["settings"]["backbone"],
    "state": lambda training: state(training["state"]),
    "done": lambda training: f"{100 * training['progress']:.0f} %",
    "figures": _figures,
}
