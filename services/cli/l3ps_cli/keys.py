"""``l3ps keys``: the tokens of a project."""

from __future__ import annotations

from typing import Annotated

import typer

from l3ps_cli.console import AsJson, done, items_of, out, print_items, service_errors
from l3ps_client import Client, Key

app = typer.Typer(help="API keys of the project, for whoever may administer it.", no_args_is_help=True)


@app.command()
def create(
    name: Annotated[str, typer.Argument(help="What it is for.")],
    scope: Annotated[str, typer.Option(help="read, write or admin.")] = "read",
    expires_at: Annotated[str | None, typer.Option(help="Refuse it from this time on (ISO 8601).")] = None,
    as_json: AsJson = False,
) -> None:
    """Make a key. Its secret, the token, is shown now and never again."""
    with service_errors(), Client() as client:
        _print(client.keys.create(name, scope, expires_at=expires_at), as_json)


@app.command("list")
def listed(as_json: AsJson = False) -> None:
    """List the project's keys, without their secrets."""
    with service_errors(), Client() as client:
        page = items_of(client.keys.list())
    print_items(page, COLUMNS, as_json=as_json, nothing="No keys yet: `l3ps keys create NAME` makes one.")


@app.command()
def rotate(
    key: Annotated[str, typer.Argument(help="Id of a key.")],
    overlap: Annotated[int | None, typer.Option(min=0, help="Seconds for which the old secret still works.")] = None,
    as_json: AsJson = False,
) -> None:
    """Give a key a new secret, which is shown now and never again."""
    with service_errors(), Client() as client:
        _print(client.keys.rotate(key, overlap_seconds=overlap), as_json)


@app.command()
def revoke(key: Annotated[str, typer.Argument(help="Id of a key.")], as_json: AsJson = False) -> None:
    """Refuse a key from now on."""
    with service_errors(), Client() as client:
        client.keys.revoke(key)
    done(f"Key {key} is revoked.", {"id": key, "revoked": True}, as_json=as_json)


def _print(key: Key, as_json: bool) -> None:
    """The secret alone on standard output, so that a script can take it; the rest beside it."""
    if as_json:
        out.print_json(data=key)
        return
    done(f"key {key['id']}: {key['name']}, {key['scope']}", as_json=False)
    done(key.get("secret") or "", as_json=False)


COLUMNS = {
    "key": lambda key: key["id"],
    "name": lambda key: key["name"],
    "scope": lambda key: key["scope"],
    "made": lambda key: key["created_at"][:19],
    "expires": lambda key: (key.get("expires_at") or "never")[:19],
}
