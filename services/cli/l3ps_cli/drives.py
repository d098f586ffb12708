"""``l3ps drives``: the drive logs that the service has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from l3ps_cli.console import AsJson, Limit, done, out, print_items, service_errors, state
from l3ps_cli.submit import check_log, upload_log
from l3ps_client import Client

app = typer.Typer(help="Drive logs that the service has.", no_args_is_help=True)


@app.command("list")
def listed(limit: Limit = 20, as_json: AsJson = False) -> None:
    """List drives, newest first."""
    with service_errors(), Client() as client:
        page = client.drives.page(limit=limit)
    print_items(page, COLUMNS, as_json=as_json, nothing="No drives yet: `l3ps drives upload LOG` brings one.")


@app.command()
def show(drive: Annotated[str, typer.Argument(help="Id of a drive.")], as_json: AsJson = False) -> None:
    """Show what the check found in a drive."""
    with service_errors(), Client() as client:
        document = client.drives.get(drive)
    if as_json:
        out.print_json(data=document)
        return
    done(f"{document['id']}: {document['name']}, {document['state']}", as_json=False)
    for scene in (document["info"] or {}).get("scenes") or []:
        done(f"  {scene['name']}: {scene['scans']} scans, {scene['points']} points", as_json=False)
    for problem in document["problems"]:
        out.print(f"  {problem['where']}: {problem['what']}. {problem['remedy']}", style="red", markup=False)
    more = document.get("problem_count", 0) - len(document["problems"])
    if more > 0:
        out.print(f"  … and {more} more.", style="red")


@app.command()
def upload(
    log: Annotated[Path, typer.Argument(help="Drive log: a directory or an archive.")], as_json: AsJson = False
) -> None:
    """Upload a drive log, unless the service has it already; interrupted, the same command goes on."""
    with service_errors(), Client() as client:
        check_log(log)
        drive = upload_log(client, log)
    done(f"drive {drive['id']}: {drive['name']}", drive, as_json=as_json)


@app.command()
def delete(drive: Annotated[str, typer.Argument(help="Id of a drive.")], as_json: AsJson = False) -> None:
    """Delete a drive's archive. Refused while a job uses it; finished jobs keep their labels."""
    with service_errors(), Client() as client:
        client.drives.delete(drive)
    done(f"Drive {drive} is deleted.", {"id": drive, "deleted": True}, as_json=as_json)


def _scans(drive: Any) -> str:
    return str((drive["info"] or {}).get("scans") or "")


COLUMNS = {
    "drive": lambda drive: drive["id"],
    "name": lambda drive: drive["name"],
    "state": lambda drive: state(drive["state"]),
    "format": lambda drive: drive["format"] or "",
    "MB": lambda drive: f"{drive['size'] / 1e6:.1f}",
    "scans": _scans,
    "made": lambda drive: drive["created_at"][:19],
}
