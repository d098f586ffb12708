"""``l3ps models``: the model bundles that the service has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from l3ps_cli.console import AsJson, Limit, done, print_items, service_errors, state
from l3ps_cli.packing import bundle_name
from l3ps_cli.submit import upload_bundle
from l3ps_client import Client

app = typer.Typer(help="Model bundles that the service has.", no_args_is_help=True)


@app.command("list")
def listed(limit: Limit = 20, as_json: AsJson = False) -> None:
    """List models, newest first."""
    with service_errors(), Client() as client:
        page = client.models.page(limit=limit)
    print_items(page, COLUMNS, as_json=as_json, nothing="No models yet: `l3ps models upload BUNDLE` brings one.")


@app.command()
def upload(
    bundle: Annotated[Path, typer.Argument(help="Model bundle: directory or zip.")],
    name: Annotated[str | None, typer.Option(help="What to call it; default: what it calls itself.")] = None,
    as_json: AsJson = False,
) -> None:
    """Upload a model bundle, unless the service has it already."""
    with service_errors(), Client() as client:
        called = upload_bundle(client, bundle, name or bundle_name(bundle))
        model = client.models.get(called)
    done(f"model {called}: {model['state']}", model, as_json=as_json)


@app.command()
def delete(model: Annotated[str, typer.Argument(help="Name or id of a model.")], as_json: AsJson = False) -> None:
    """Delete a model. Refused while a job uses it; finished jobs keep their labels."""
    with service_errors(), Client() as client:
        client.models.delete(model)
    done(f"Model {model} is deleted.", {"id": model, "deleted": True}, as_json=as_json)


def _classes(model: Any) -> str:
    return str(len((model["info"] or {}).get("classes") or []) or "")


COLUMNS = {
    "model": lambda model: model["id"],
    "name": lambda model: model["name"],
    "state": lambda model: state(model["state"]),
    "MB": lambda model: f"{model['size'] / 1e6:.1f}",
    "classes": _classes,
    "made": lambda model: model["created_at"][:19],
}
