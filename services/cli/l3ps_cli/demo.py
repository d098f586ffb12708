"""``l3ps demo``: the main job from end to end, through the real service, on a simulated or a given drive."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from l3ps_cli.console import JOB_FAILED, err, fail, out, service_errors
from l3ps_cli.download import fetch_labels
from l3ps_cli.draw import draw
from l3ps_cli.processes import ChildDiedError
from l3ps_cli.progress import bars
from l3ps_cli.report import quality_table, stage_table
from l3ps_cli.stack import Stack, StackError, StackOptions
from l3ps_cli.submit import check_log, ensure_model, require_success, upload_log
from l3ps_cli.up import StopRequested, stop_on_signals
from l3ps_cli.watch import wait_for_job
from l3ps_client import Client, Job

DEMO_MODEL = Path(__file__).parent / "models" / "demo"
SCENES, SCANS, SEED = 2, 10, 7


def demo(
    drive: Annotated[
        Path | None, typer.Option(help="Drive log (directory or archive); default: a simulated one.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Model bundle; default: the packaged demo model.")] = None,
    preset: Annotated[str, typer.Option(help="paper, best or fast.")] = "best",
    segment: Annotated[str, typer.Option(help="Look at images: fast, balanced or paper.")] = "fast",
    data: Annotated[Path, typer.Option(help="Directory for everything the demo makes.", file_okay=False)] = Path(
        "demo"
    ),
) -> None:
    """Label a drive with the embedded service and show how good the labels are, primal beside refined."""
    start = time.monotonic()
    threads = min(2, os.cpu_count() or 1)
    options = StackOptions(data / "service", port=0, workers=max(1, (os.cpu_count() or 1) // threads), threads=threads)
    try:
        with stop_on_signals(), service_errors():
            if drive:
                check_log(drive)
            log = drive or _simulated(data / "drive")
            with (
                Stack(options, lambda step: err.print(f"[dim]{step}[/dim]")) as stack,
                Client(stack.url, stack.token) as client,
            ):
                job = _run(client, stack, log, model or DEMO_MODEL, preset, segment)
                labels = data / "labels" / job["id"]
                fetch_labels(client, job["id"], labels)
    except StopRequested:
        fail("The demo was stopped; the service it had started is gone.", JOB_FAILED)
    except ChildDiedError as error:
        fail(f"{error}. Its last lines:\n{error.last_lines}", JOB_FAILED)
    except (StackError, TimeoutError) as error:
        fail(str(error), JOB_FAILED)
    out.print(stage_table(job))
    if job["quality"]:
        out.print(quality_table(job["quality"]))
    else:
        out.print("The log carries no truth, so there are no quality figures.")
    out.print(f"labels: {labels}", highlight=False, soft_wrap=True)
    for coloring in ("class", "instance"):
        draw(log, output=data / f"{coloring}.png", labels=labels / "refined", by=coloring)
    out.print(f"{time.monotonic() - start:.0f} seconds in all", highlight=False)


def _run(client: Client, stack: Stack, log: Path, model: Path, preset: str, segment: str) -> Job:
    name = ensure_model(client, str(model))
    document = upload_log(client, log)
    job = client.jobs.create(drive_id=document["id"], model=name, preset=preset, segment=segment)
    job = wait_for_job(client, job["id"], err, stack.check)
    require_success(job)
    return job


def _simulated(folder: Path) -> Path:
    """The demo's simulated drive, made unless it is there already (it is the same every time)."""
    if not folder.is_dir():
        from l3ps.simulate import simulate_drive

        with bars() as progress:
            simulate_drive(folder, scenes=SCENES, scans=SCANS, seed=SEED, progress=progress)
    return folder
