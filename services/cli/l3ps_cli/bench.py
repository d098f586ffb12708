"""``l3ps bench``: what each stage costs, beside other packages on the same points in the same run."""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from l3ps.drivelog import opened
from l3ps.drivelog.types import Drive, Points, Scan, Scene
from l3ps.labels import ScanLabels
from l3ps.pipeline import refine_scene
from l3ps.presets import DEFAULT_PRESET, PRESETS
from l3ps.refine.accumulate import transform
from l3ps.refine.cluster import hdbscan_package
from l3ps.refine.ground import GroundSegmenter
from l3ps.taxonomy import NUSCENES16
from l3ps_cli.errors import BAD_INPUT, clear_errors, fail, out
from l3ps_cli.progress import bars

app = typer.Typer(help="Measure on your own logs.", no_args_is_help=True)


@app.callback()
def bench() -> None:
    """Measure on your own logs."""


@app.command()
def refine(
    log: Annotated[Path, typer.Option(help="Drive log.")],
    scans: Annotated[int | None, typer.Option(min=1, help="Only the first scans of the scene.")] = None,
    scene: Annotated[str | None, typer.Option(help="This scene in place of the first.")] = None,
    preset: Annotated[str, typer.Option(help=f"{', '.join(PRESETS)}.")] = DEFAULT_PRESET,
    threads: Annotated[int, typer.Option(min=1)] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Seconds and peak memory of each refinement stage on the first scene of a log.

    No model is needed: the log's truth stands for the primal labels, or where it has none, labels by height.
    """
    with clear_errors():
        if preset not in PRESETS:
            fail(f"--preset: there is no '{preset}'. Use one of {', '.join(PRESETS)}.", BAD_INPUT)
        figures = _figures(log, scans, scene, preset, threads)
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        _show(figures)


def _figures(log: Path, scans: int | None, scene: str | None, preset: str, threads: int) -> dict[str, Any]:
    with opened(log) as drive:
        chosen = next((s for s in drive.scenes if scene in (None, s.name)), None)
        if chosen is None:
            raise typer.BadParameter(f"the log has no scene '{scene}'", param_hint="--scene")
        part = Scene(chosen.name, chosen.scans[:scans])
        clouds = [scan.load_points() for scan in part.scans]
        primal = [_stand_in(drive, scan, cloud) for scan, cloud in zip(part.scans, clouds, strict=True)]
        with bars() as progress:
            refined = refine_scene(
                part, primal, PRESETS[preset], sensor_height=drive.sensor_height, threads=threads, progress=progress
            )
        return {
            "log": log.name,
            "scene": part.name,
            "scans": len(part.scans),
            "points": sum(map(len, clouds)),
            "preset": preset,
            "threads": threads,
            "stages": {name: asdict(cost) for name, cost in refined.costs.items()},
            "seconds": sum(cost.seconds for cost in refined.costs.values()),
            "peak_mb": max(cost.peak_mb for cost in refined.costs.values()),
            "clustering": _peers(clouds, refined.poses, drive.sensor_height, PRESETS[preset].min_cluster_size, threads),
        }


def _peers(
    clouds: list[Points], poses: NDArray[np.float64], sensor_height: float | None, size: int, threads: int
) -> dict[str, float | None]:
    """Seconds that each installed package takes to cluster both partitions; None where it is not installed."""
    split = GroundSegmenter(sensor_height)
    ground = np.concatenate([split(cloud.xyz, cloud.intensity) for cloud in clouds])
    points = np.concatenate([transform(cloud.xyz, pose) for cloud, pose in zip(clouds, poses, strict=True)])
    partitions = [points[~ground], points[ground]]
    packages: dict[str, Callable[[NDArray[np.float32]], object] | None] = {
        "hdbscan": lambda part: hdbscan_package(part, size, threads),
        "fast_hdbscan": None,
    }
    if importlib.util.find_spec("fast_hdbscan"):
        from fast_hdbscan import HDBSCAN

        HDBSCAN(min_cluster_size=size).fit(partitions[0][:1000])  # its first call compiles for a minute
        packages["fast_hdbscan"] = lambda part: HDBSCAN(min_cluster_size=size).fit(part)
    seconds: dict[str, float | None] = {}
    for name, cluster in packages.items():
        if cluster is None:
            seconds[name] = None
            continue
        began = time.perf_counter()
        for part in partitions:
            cluster(part)
        seconds[name] = time.perf_counter() - began
    return seconds


def _stand_in(drive: Drive, scan: Scan, cloud: Points) -> ScanLabels:
    """Labels that cost about what real ones do: the truth, or road, cars and buildings by height."""
    if scan.load_truth is not None and drive.truth_space == NUSCENES16.name:
        truth = scan.load_truth()
        return ScanLabels(scan.token, truth.semantic, truth.instance)
    z = cloud.xyz[:, 2]
    semantic = np.full(len(z), NUSCENES16.index("manmade"), dtype=np.uint8)
    semantic[z < 0] = NUSCENES16.index("car")
    semantic[z < -1.4] = NUSCENES16.index("driveable_surface")
    return ScanLabels(scan.token, semantic, (semantic == NUSCENES16.index("car")).astype(np.int32))


def _show(figures: dict[str, Any]) -> None:
    title = f"Refinement of {figures['points']:,} points, {figures['scans']} scans, preset {figures['preset']}"
    table = Table("stage", title=title, title_justify="left")
    for column in ("seconds", "CPU s", "peak MB"):
        table.add_column(column, justify="right")
    for name, cost in figures["stages"].items():
        table.add_row(name, f"{cost['seconds']:.2f}", f"{cost['cpu_seconds']:.2f}", f"{cost['peak_mb']:.0f}")
    table.add_section()
    table.add_row("all", f"{figures['seconds']:.2f}", "", f"{figures['peak_mb']:.0f}", style="bold")
    out.print(table)
    for name, seconds in figures["clustering"].items():
        took = "not installed" if seconds is None else f"{seconds:.2f} s"
        out.print(f"clustering both partitions with {name}: {took}", highlight=False)
