"""``l3ps bench``: what each stage costs, beside other packages on the same points in the same run."""

from __future__ import annotations

import importlib.util
import json
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from l3ps.drivelog import opened
from l3ps.drivelog.types import Drive, Scene
from l3ps.errors import DriveLogError, Problem
from l3ps.presets import DEFAULT_PRESET, PRESETS
from l3ps_cli.bench_run import run_task
from l3ps_cli.bench_segment import segment
from l3ps_cli.errors import BAD_INPUT, clear_errors, fail, out

app = typer.Typer(help="Measure on your own logs.", no_args_is_help=True)

PEERS = ("fast_hdbscan", "hdbscan")
GROWTH = (1, 2, 4, 8, 16)
"""Scans of the sizes that are measured one after the other."""


@app.callback()
def bench() -> None:
    """Measure on your own logs."""


app.command()(segment)


@app.command()
def refine(
    log: Annotated[Path, typer.Option(help="Drive log.")],
    scans: Annotated[int | None, typer.Option(min=1, help="Only the first scans of the scene.")] = None,
    scene: Annotated[str | None, typer.Option(help="This scene in place of the first.")] = None,
    preset: Annotated[str, typer.Option(help=f"{', '.join(PRESETS)}.")] = DEFAULT_PRESET,
    threads: Annotated[int, typer.Option(min=1, max=256)] = 2,
    growth: Annotated[bool, typer.Option(help="Also 1, 2, 4, 8, 16 scans, as far as the scene has them.")] = True,
    peers: Annotated[bool, typer.Option(help="Also other packages' clustering; takes minutes.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Seconds and memory of each refinement stage on the first scene of a log, and how they grow with its scans.

    No model is needed: the log's truth stands for the primal labels, or where it has none, labels by height. Each
    measurement is made in a process of its own; own times are the median of three runs, those of other packages are
    of one, after a small one that lets them compile.
    """
    with clear_errors():
        if preset not in PRESETS:
            fail(f"--preset: there is no '{preset}'. Use one of {', '.join(PRESETS)}.", BAD_INPUT)
        with opened(log) as drive, tempfile.TemporaryDirectory(prefix="l3ps-bench-") as folder:
            chosen = _chosen(drive, scene)
            figures = _figures(drive, chosen, scans, preset, threads, Path(folder), growth=growth, peers=peers)
    figures = {"log": log.name, **figures}
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        _show(figures)


def _chosen(drive: Drive, name: str | None) -> Scene:
    for scene in drive.scenes:
        if name in (None, scene.name) and scene.scans:
            return scene
    known = ", ".join(scene.name for scene in drive.scenes[:10])
    what = "the log has no scene with scans" if name is None else f"the log has no scene '{name}' with scans"
    raise DriveLogError(Problem("unknown-scene", "--scene", what, f"Its scenes are: {known}."))


def _figures(
    drive: Drive,
    scene: Scene,
    scans: int | None,
    preset: str,
    threads: int,
    folder: Path,
    *,
    growth: bool,
    peers: bool,
) -> dict[str, Any]:
    total = len(scene.scans)
    taken = min(scans or total, total)
    common = {"root": str(drive.root), "scene": scene.name, "preset": preset, "threads": threads}
    own = run_task("refinement", f"Refining {taken} scans three times", folder, {**common, "scans": taken})
    seconds: dict[str, float | None] = {"l3ps": own.pop("clustering"), **dict.fromkeys(PEERS)}
    rows: list[dict[str, float]] = []
    if growth:
        sizes = [size for size in GROWTH if size <= total]
        what = f"Refining {', '.join(map(str, sizes))} scans, three times each"
        rows = run_task("growth", what, folder, {**common, "sizes": sizes})["growth"]
    size = PRESETS[preset].min_cluster_size
    for name in PEERS if peers else ():
        if importlib.util.find_spec(name) is not None:
            what = f"Clustering the same {own['points']:,} points with {name}: takes minutes for a million"
            seconds[name] = run_task(name, what, folder, {"size": size, "threads": threads})["seconds"]
    figures = {"scene": scene.name, "preset": preset, "threads": threads, **own, "clustering": seconds, "growth": rows}
    return figures | {"ratios": _ratios(seconds, figures["seconds"], rows)}


def _ratios(
    clustering: dict[str, float | None], refinement: float, growth: list[dict[str, float]]
) -> dict[str, float | None]:
    """How many times faster than each peer, and how the cost of a point grows; None where it was not measured."""
    own, fast, plain = clustering["l3ps"], clustering["fast_hdbscan"], clustering["hdbscan"]
    return {
        "clustering_vs_fast_hdbscan": fast / own if own and fast else None,
        "clustering_vs_hdbscan": plain / own if own and plain else None,
        "refine_vs_fast_hdbscan_clustering": fast / refinement if fast else None,
        "growth_1_to_max": growth[-1]["us_a_point"] / growth[0]["us_a_point"] if growth else None,
    }


def _show(figures: dict[str, Any]) -> None:
    title = f"Refinement of {figures['points']:,} points, {figures['scans']} scans, preset {figures['preset']}"
    table = Table("stage", title=title, title_justify="left")
    for column in ("seconds", "CPU s", "peak MB", "bytes a point"):
        table.add_column(column, justify="right")
    for name, cost in figures["stages"].items():
        times = (f"{cost['seconds']:.2f}", f"{cost['cpu_seconds']:.2f}")
        table.add_row(name, *times, f"{cost['peak_mb']:.0f}", f"{cost['bytes_a_point']:.0f}")
    table.add_section()
    whole = (f"{figures['seconds']:.2f}", "", f"{figures['peak_mb']:.0f}", f"{figures['bytes_a_point']:.0f}")
    table.add_row("all", *whole, style="bold")
    out.print(table)
    for row in figures["growth"]:
        line = f"{row['scans']:>3} scans: {row['points']:>10,} points, {row['seconds']:6.2f} s"
        out.print(f"{line}, {row['us_a_point']:.2f} µs a point", highlight=False)
    for name, seconds in figures["clustering"].items():
        took = "not measured" if seconds is None else f"{seconds:.2f} s"
        out.print(f"clustering both partitions with {name}: {took}", highlight=False)
    for name, ratio in figures["ratios"].items():
        if ratio is not None:
            out.print(f"{name.replace('_', ' ')}: {ratio:.2f}", highlight=False)
