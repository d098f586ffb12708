"""``l3ps submit``: a drive log and a model to a running service, and back a job."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from l3ps.errors import DriveLogError, InputError, Problem
from l3ps.presets import PRESETS
from l3ps.segment.presets import DEFAULT_SEGMENT, SEGMENT_PRESETS
from l3ps_cli.console import BAD_INPUT, JOB_FAILED, bytes_bar, err, fail, out, service_errors
from l3ps_cli.errors import INTERRUPTED
from l3ps_cli.packing import ARCHIVE_SUFFIXES, bundle_name, is_archive_name, pack_bundle, pack_log, sha256_of
from l3ps_cli.watch import wait_for_job
from l3ps_client import Annotations, Client, Drive, Job, sentences

Kind = Literal["drive", "annotations"]


def submit(
    log: Annotated[str, typer.Argument(help="Drive log: a directory, an archive, or s3://bucket/prefix.")],
    *,
    model: Annotated[str, typer.Option(help="Name of a model the service has, or a bundle (directory or zip).")],
    preset: Annotated[str, typer.Option(help="paper, best or fast.")] = "best",
    segment: Annotated[str, typer.Option(help=f"Look at images: {', '.join(SEGMENT_PRESETS)}.")] = DEFAULT_SEGMENT,
    formats: Annotated[
        list[str] | None, typer.Option("--format", help="Label format: nuscenes, semantickitti; may be repeated.")
    ] = None,
    protocol: Annotated[
        str | None, typer.Option(help="Protocol of the quality figures: nuscenes, paper or semantickitti.")
    ] = None,
    skip_bad_scans: Annotated[
        bool, typer.Option("--skip-bad-scans", help="Label the good scans of a log that has bad ones.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until the job is over, showing its progress.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the job's document.")] = False,
) -> None:
    """Upload a drive log, start a job on it and, with --wait, see it through; a log in a bucket is not uploaded.

    Exit codes: 0 done, 1 the job failed, 2 bad input, 3 the service cannot be reached.
    """
    with service_errors(), Client() as client:
        by_reference = log.startswith("s3://")
        if not by_reference:
            check_log(Path(log))
        _check_settings(preset, segment, formats, protocol)
        model_name = ensure_model(client, model)
        job = client.jobs.create(
            drive_id=None if by_reference else upload_log(client, Path(log))["id"],
            source=log if by_reference else None,
            model=model_name,
            preset=preset,
            segment=segment,
            formats=formats,
            protocol=protocol,
            skip_bad_scans=skip_bad_scans,
        )
        if wait:
            try:
                job = wait_for_job(client, job["id"], err)
            except KeyboardInterrupt:
                fail(f"Job {job['id']} goes on; `l3ps jobs {job['id']} --cancel` stops it.", INTERRUPTED)
    if as_json:
        out.print_json(data=job)
    else:
        out.print(f"job {job['id']}: {job['state']}", highlight=False)
    if wait:
        require_success(job)


def _check_settings(preset: str, segment: str, formats: list[str] | None, protocol: str | None) -> None:
    """InputError for what the service would refuse only once a large log has been sent."""
    from l3ps.evaluate import PROTOCOLS
    from l3ps.labels import FORMATS

    asked: list[tuple[str, str, Sequence[str]]] = [
        ("--preset", preset, list(PRESETS)),
        ("--segment", segment, list(SEGMENT_PRESETS)),
        ("--protocol", protocol or "nuscenes", list(PROTOCOLS)),
        *(("--format", one, FORMATS) for one in formats or ()),
    ]
    for option, value, known in asked:
        if value not in known:
            what, remedy = f"there is no '{value}'", f"Use one of {', '.join(known)}."
            raise InputError(Problem("unknown-setting", option, what, remedy))


def require_success(job: Job) -> None:
    """End the command with the reason and the exit code for it where a finished job did not succeed."""
    if job["state"] == "cancelled":
        fail(f"Job {job['id']} was cancelled.", JOB_FAILED)
    if job["state"] == "failed":
        why: dict[str, Any] = {
            "detail": f"Job {job['id']} failed. {job.get('message') or ''}",
            "errors": job.get("errors"),
        }
        rejected = "rejected" in (job["drive"].get("state"), job["model"].get("state"))
        fail("\n".join(sentences(why)), BAD_INPUT if rejected else JOB_FAILED)


def ensure_model(client: Client, model: str) -> str:
    """The name of a model that the service has; a bundle given by path is uploaded unless it is there already."""
    path = Path(model)
    if not (path.is_dir() or path.is_file()):
        client.models.get(model)  # an unknown name is said before a log is sent
        return model
    return upload_bundle(client, path, bundle_name(path))


def upload_bundle(client: Client, path: Path, name: str) -> str:
    """Upload a model bundle, directory or zip, under a name, unless the service has it already; returns the name."""
    with tempfile.TemporaryDirectory(prefix="l3ps-") as scratch:
        archive = path
        if path.is_dir():
            archive = Path(scratch) / f"{name}.zip"
            pack_bundle(path, archive)
        sha256 = sha256_of(archive)
        known = client.models.find(name)
        if known is not None and known["sha256"] == sha256 and known["state"] != "rejected":
            return name
        with bytes_bar("uploading the model", archive.stat().st_size) as report:
            client.models.upload(archive, name=name, sha256=sha256, progress=report)
    return name


def check_log(log: Path, what_it_is: str = "a drive log") -> None:
    """Raise DriveLogError when a log, or whatever it is, is neither a directory nor an archive the service takes."""
    if log.is_dir():
        return
    if not log.is_file():
        what, remedy = "there is no such file or directory", f"Name {what_it_is}."
        raise DriveLogError(Problem("no-log", str(log), what, remedy))
    if not is_archive_name(log):
        what, remedy = "it is no archive by its name", f"Give a directory or a {', '.join(ARCHIVE_SUFFIXES)}."
        raise DriveLogError(Problem("no-archive", str(log), what, remedy))


def upload_log(client: Client, log: Path, kind: Kind = "drive") -> Drive | Annotations:
    """Upload a log or annotations that ``check_log`` passed, unless the service has some of the same bytes.

    Args:
        client: the service.
        log: directory or archive.
        kind: ``drive`` or ``annotations``.

    Returns:
        The drive's or the annotations' document.
    """
    if log.is_dir():
        with tempfile.TemporaryDirectory(prefix="l3ps-") as scratch:
            archive = Path(scratch) / f"{log.resolve().name}.tar"
            with bytes_bar("packing") as report:
                pack_log(log, archive, report)
            return _upload_archive(client, archive, log.resolve().name, kind)
    name = log.name
    for suffix in sorted(ARCHIVE_SUFFIXES, key=len, reverse=True):
        name = name.removesuffix(suffix)
    return _upload_archive(client, log, name, kind)


def _upload_archive(client: Client, archive: Path, name: str, kind: Kind) -> Drive | Annotations:
    with bytes_bar("checksum") as report:
        sha256 = sha256_of(archive, report)
    files = client.drives if kind == "drive" else client.annotations
    known = files.find(sha256)
    if known is not None:
        called = {"drive": "this log", "annotations": "these annotations"}[kind]
        err.print(f"the service has {called} already: {known['id']}", highlight=False)
        return known
    with bytes_bar("uploading", archive.stat().st_size) as report:
        return files.upload(archive, name=name, sha256=sha256, progress=report)
