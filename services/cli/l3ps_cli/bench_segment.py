"""``l3ps bench segment``: images a second from file to labels, beside the network alone."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from l3ps.drivelog import open_drive, opened
from l3ps.errors import DriveLogError, Problem
from l3ps.presets import PAPER
from l3ps.segment.presets import DEFAULT_SEGMENT, SEGMENT_PRESETS
from l3ps_cli.bench_run import run_task
from l3ps_cli.errors import BAD_INPUT, clear_errors, fail, out

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
FUSIONS = ("components", "cuts")


def segment(
    model: Annotated[Path, typer.Option(help="Model bundle: a directory or zip.")],
    images: Annotated[Path, typer.Option(help="Drive log, or a folder of images.")],
    preset: Annotated[
        str, typer.Option("--segment", help=f"Look at images: {', '.join(SEGMENT_PRESETS)}.")
    ] = DEFAULT_SEGMENT,
    fusion: Annotated[str | None, typer.Option(help=f"{', '.join(FUSIONS)}; default: the preset's.")] = None,
    count: Annotated[int, typer.Option(min=2, help="Images in all; those found are taken again and again.")] = 48,
    rounds: Annotated[int, typer.Option(min=1, help="Turns in which the measurements take the images.")] = 4,
    threads: Annotated[int, typer.Option(min=1, max=256)] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Images a second end to end beside the bare onnxruntime session's on the same inputs, in turns.

    End to end is from image file to panoptic labels with class scores, as `l3ps label` has them before they are
    projected. Bare is the session alone on inputs prepared before, with as many threads, or with onnxruntime's own
    defaults; the third figure is that of as many passes side by side as end to end has. A busy machine hurts all
    alike: the ratio is the median over the rounds. Memory is measured in a process of its own.
    """
    if preset not in SEGMENT_PRESETS:
        fail(f"--segment: there is no '{preset}'. Use one of {', '.join(SEGMENT_PRESETS)}.", BAD_INPUT)
    if fusion not in (None, *FUSIONS):
        fail(f"--fusion: there is no '{fusion}'. Use one of {', '.join(FUSIONS)}.", BAD_INPUT)
    with clear_errors(), _images(images) as found, tempfile.TemporaryDirectory(prefix="l3ps-bench-") as folder:
        chosen = list(islice(cycle(found), count))
        arguments = {
            "model": str(model.resolve()),
            "images": [str(path) for path in chosen],
            "segment": preset,
            "fusion": fusion or SEGMENT_PRESETS[preset].fusion,
            "min_area": PAPER.min_area,
            "threads": threads,
        }
        what = f"{count} images, {rounds} rounds"
        figures = run_task("segmentation", what, Path(folder), {**arguments, "rounds": min(rounds, count // 2)})
        memory = run_task("segmentation_memory", "Memory", Path(folder), arguments)
    figures = {"images": images.name, "distinct": len(set(chosen)), **figures, **memory}
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        _show(figures)


@contextmanager
def _images(where: Path) -> Iterator[list[Path]]:
    """The camera images of a drive log, or all images below a folder that is none."""
    if where.is_dir() and not _is_log(where):
        found = sorted(path.resolve() for path in where.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
        yield _some(found, where)
        return
    with opened(where) as drive:
        scans = [scan for scene in drive.scenes for scan in scene.scans]
        yield _some([camera.path for scan in scans for camera in scan.cameras], where)


def _is_log(folder: Path) -> bool:
    try:
        open_drive(folder)
    except DriveLogError as error:
        return error.problems[0].code != "no-log"
    return True


def _some(found: list[Path], where: Path) -> list[Path]:
    if not found:
        remedy = "Name a drive log with cameras, or a folder of JPEG or PNG images."
        raise DriveLogError(Problem("no-images", str(where), "there is no image in it", remedy))
    return found


def _show(figures: dict[str, Any]) -> None:
    width, height = figures["input"]
    title = f"{figures['model']} at {width}×{height}, {figures['count']} images, {figures['threads']} threads"
    table = Table("", title=title, title_justify="left")
    for column in ("images/s", "s an image", "end to end is"):
        table.add_column(column, justify="right")
    for name, told in figures["rates"].items():
        ratio = figures["ratios"].get(name)
        cells = (f"{told['images_per_second']:.2f}", f"{told['seconds_an_image']:.3f}")
        table.add_row(name.replace("_", " "), *cells, "" if ratio is None else f"{ratio:.2f} of it")
    out.print(table)
    for name, told in figures["steps"].items():
        line = f"{name:>8}: {1000 * told['seconds_an_image']:7.1f} ms of a thread, {100 * told['share']:5.1f} %"
        out.print(line, highlight=False)
    out.print(f"peak memory {figures['peak_mb']:.0f} MB, {figures['before_mb']:.0f} before", highlight=False)
