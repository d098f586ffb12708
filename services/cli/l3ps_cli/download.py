"""``l3ps download``: a job's label files, each checked against its sha256."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Annotated, Any
from urllib.parse import quote

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

from l3ps_cli.client import Client
from l3ps_cli.console import JOB_FAILED, err, fail, out, service_errors
from l3ps_cli.packing import sha256_of

_PARALLEL_FILES = 4


class DamagedDownloadError(Exception):
    """A file that is not what the service announced."""


def download(
    job: Annotated[str, typer.Argument(help="Id of a finished job.")],
    out_dir: Annotated[Path, typer.Option("--out", help="Directory for the files.", file_okay=False)],
    label_format: Annotated[
        str | None, typer.Option("--format", help="nuscenes or semantickitti; default: the job's first.")
    ] = None,
) -> None:
    """Download a finished job's labels; files already there and whole are not fetched again."""
    with service_errors(), Client() as client:
        try:
            files = fetch_labels(client, job, out_dir, label_format)
        except DamagedDownloadError as error:
            fail(str(error), JOB_FAILED)
    out.print(f"{len(files)} files in {out_dir}", highlight=False)


def fetch_labels(client: Client, job: str, folder: Path, label_format: str | None = None) -> list[Path]:
    """Download a job's label files below ``folder``; returns their paths.

    Raises DamagedDownloadError when a file's bytes are not those the service announced.
    """
    listing = client.get(f"/jobs/{quote(job, safe='')}/labels", format=label_format)
    files: list[dict[str, Any]] = listing["files"]
    with Progress(TextColumn("labels"), BarColumn(), DownloadColumn(), console=err) as progress:
        bar = progress.add_task("labels", total=sum(file["size"] for file in files))

        def fetch(file: dict[str, Any]) -> Path:
            return _fetch_one(client, file, folder, lambda count: progress.advance(bar, count))

        with ThreadPoolExecutor(_PARALLEL_FILES) as pool:
            return list(pool.map(fetch, files))


def _fetch_one(client: Client, file: dict[str, Any], folder: Path, report: Callable[[int], None]) -> Path:
    target = folder / _inside(file["path"])
    if target.is_file() and target.stat().st_size == file["size"] and sha256_of(target) == file["sha256"]:
        report(file["size"])
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    client.fetch(file["url"], target, report)
    if (found := sha256_of(target)) != file["sha256"]:
        target.unlink()
        raise DamagedDownloadError(
            f"{file['path']} arrived damaged (sha256 {found}, announced {file['sha256']}) and was removed. Try again."
        )
    return target


def _inside(path: str) -> PurePosixPath:
    """A path of the service's listing, refused when it would leave the target directory."""
    relative = PurePosixPath(path)
    if relative.is_absolute() or ".." in relative.parts or not relative.parts:
        raise DamagedDownloadError(f"The service names a file outside the target directory: {path!r}. Nothing written.")
    return relative
