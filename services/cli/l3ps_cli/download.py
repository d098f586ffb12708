"""``l3ps download``: jobs' label files, each checked against its sha256, or all as one archive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from l3ps_cli.console import bytes_bar, done, service_errors
from l3ps_client import Client


def download(
    job: Annotated[list[str], typer.Argument(help="Id of a finished job; several with --archive.")],
    *,
    out_dir: Annotated[Path, typer.Option("--out", help="Directory for the files; with --archive the tar to write.")],
    label_format: Annotated[
        str | None, typer.Option("--format", help="nuscenes or semantickitti; default: the job's first.")
    ] = None,
    scene: Annotated[list[str] | None, typer.Option(help="Only this scene; may be repeated.")] = None,
    scan: Annotated[list[str] | None, typer.Option(help="Only this scan; may be repeated.")] = None,
    side: Annotated[str | None, typer.Option(help="Only primal or only refined labels.")] = None,
    archive: Annotated[bool, typer.Option("--archive", help="One tar of all files, streamed.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the paths of the files.")] = False,
) -> None:
    """Download finished jobs' labels; what is already there and whole is not fetched again."""
    if archive and (scene or scan or side):
        raise typer.BadParameter("--archive takes whole jobs: leave --scene, --scan and --side out")
    if len(job) > 1 and not archive:
        raise typer.BadParameter("several jobs come as one archive: add --archive")
    with service_errors(), Client() as client:
        if archive:
            with bytes_bar("labels") as report:
                client.labels.archive(job[0] if len(job) == 1 else job, out_dir, format=label_format, progress=report)
            done(
                f"{'labels' if len(job) == 1 else f'{len(job)} jobs'} in {out_dir}",
                {"files": [str(out_dir)]},
                as_json=as_json,
            )
        else:
            chosen: dict[str, Any] = {"scenes": scene or (), "scans": scan or (), "side": side}
            files = fetch_labels(client, job[0], out_dir, format=label_format, **chosen)
            done(f"{len(files)} files in {out_dir}", {"files": [str(file) for file in files]}, as_json=as_json)


def fetch_labels(client: Client, job: str, folder: Path, **chosen: Any) -> Sequence[Path]:
    """Download a job's label files below ``folder`` behind a bar; ``chosen`` as of ``client.labels.download``."""
    with bytes_bar("labels") as report:
        return client.labels.download(job, folder, progress=report, **chosen)
