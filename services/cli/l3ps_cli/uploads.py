"""``l3ps uploads``: files on their way to the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from l3ps_cli.console import (
    BAD_INPUT,
    AsJson,
    Limit,
    bytes_bar,
    done,
    fail,
    print_items,
    service_errors,
    state,
)
from l3ps_client import Client

app = typer.Typer(help="Files on their way to the service.", no_args_is_help=True)


@app.command("list")
def listed(
    limit: Limit = 20,
    only: Annotated[str | None, typer.Option("--state", help="open, complete or aborted.")] = "open",
    as_json: AsJson = False,
) -> None:
    """List uploads, newest first; those that are open unless told otherwise."""
    with service_errors(), Client() as client:
        page = client.uploads.page(limit=limit, state=only or None)
    print_items(page, COLUMNS, as_json=as_json, nothing="There are none.")


@app.command()
def resume(
    file: Annotated[Path, typer.Argument(help="Archive whose upload was interrupted.", exists=True, dir_okay=False)],
    as_json: AsJson = False,
) -> None:
    """Go on with an interrupted upload of a file: what the service has got is not sent again."""
    with service_errors(), Client() as client:
        known = client.uploads.unfinished(file)
        if not known:
            fail(f"This machine knows of no unfinished upload of {file}. Submit it anew.", BAD_INPUT)
        for facts in known:
            announced = facts["announced"]
            with bytes_bar("uploading", announced["size"]) as report:
                document = client.uploads.send(
                    file, announced["kind"], name=facts.get("name"), sha256=announced.get("sha256"), progress=report
                )
            done(f"{announced['kind']} {document['id']}: {document['name']}", document, as_json=as_json)


@app.command()
def abort(upload: Annotated[str, typer.Argument(help="Id of an open upload.")], as_json: AsJson = False) -> None:
    """Give an open upload up; its parts are deleted."""
    with service_errors(), Client() as client:
        client.uploads.abort(upload)
    done(f"Upload {upload} is given up.", {"id": upload, "state": "aborted"}, as_json=as_json)


COLUMNS = {
    "upload": lambda upload: upload["id"],
    "kind": lambda upload: upload["kind"],
    "file": lambda upload: upload["filename"],
    "MB": lambda upload: f"{upload['size'] / 1e6:.1f}",
    "state": lambda upload: state(upload["state"]),
    "expires": lambda upload: upload["expires_at"][:19],
}
