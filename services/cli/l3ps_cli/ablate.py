"""``l3ps ablate``: what each part of the refinement is worth on your own logs with truth."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from l3ps.drivelog import opened
from l3ps.drivelog.types import Drive, Scene
from l3ps.errors import LabelError, Problem
from l3ps.evaluate import PROTOCOLS, IdConsistency, PanopticEvaluator, Quality, evaluate_scene, follow_ids
from l3ps.evaluate.tracking import MIN_SCANS
from l3ps.labels import ScanLabels
from l3ps.pipeline import primal_labels, refine_scene
from l3ps.presets import BEST, PAPER, Preset
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.session import Segmenter
from l3ps_cli.demo import DEMO_MODEL
from l3ps_cli.errors import BAD_INPUT, clear_errors, fail, out
from l3ps_cli.progress import bars

CLUSTER_SIZES = (3, 5, 10, 20, 50)
"""The paper's parameter study of HDBSCAN's s."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: a preset, and what it is called."""

    name: str
    preset: Preset


def ablate(
    log: Annotated[list[Path], typer.Option(help="Drive log with truth; may be given several times.")],
    model: Annotated[Path, typer.Option(help="Model bundle; default: the packaged demo model.")] = DEMO_MODEL,
    scene: Annotated[str | None, typer.Option(help="Only this scene.")] = None,
    protocol: Annotated[str, typer.Option(help=f"{', '.join(PROTOCOLS)}.")] = "nuscenes",
    sizes: Annotated[bool, typer.Option("--sizes/--no-sizes", help="Also vary min_cluster_size.")] = True,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads of each step.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON, in per cent.")] = False,
) -> None:
    """Refine the same primal labels with each component of `best` taken away in turn, and score every variant.

    The first rows are the primal labels, the published rules (`paper`) and `best`; then `best` with one component set
    back to what `paper` does; then the published rules with other cluster sizes, as in the paper.
    """
    if protocol not in PROTOCOLS:
        fail(f"--protocol: there is no '{protocol}'. Use one of {', '.join(PROTOCOLS)}.", BAD_INPUT)
    rows = list(variants(sizes))
    with clear_errors():
        bundle = ModelBundle.load(model)
        segmenter = Segmenter(bundle, threads, BEST.min_area)
        results = [_one_log(path, scene, segmenter, rows, protocol, threads) for path in log]
    figures = {"model": bundle.info.name, "protocol": protocol, "logs": results}
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        for result in results:
            out.print(_table(result, protocol))


def variants(sizes: bool = True) -> Iterator[Row]:
    """The presets to compare: ``paper``, ``best``, ``best`` less each component, ``paper`` with other cluster sizes."""
    yield Row("paper", PAPER)
    yield Row("best", BEST)
    for name, preset in _set_back(BEST, PAPER):
        yield Row(f"best, paper's {name}", preset)
    if sizes:
        for size in CLUSTER_SIZES:
            yield Row(f"paper, min_cluster_size {size}", replace(PAPER, min_cluster_size=size))
            yield Row(f"best, min_cluster_size {size}", replace(BEST, min_cluster_size=size))


def _set_back(preset: Any, base: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """``preset`` with one field at a time as ``base`` has it, groups of parameters field by field."""
    for field in fields(preset):
        own, other = getattr(preset, field.name), getattr(base, field.name)
        if field.name == "name" or own == other:
            continue
        if is_dataclass(own) and is_dataclass(other):
            for name, changed in _set_back(own, other, f"{prefix}{field.name}."):
                yield name, replace(preset, **{field.name: changed})
        else:
            yield f"{prefix}{field.name}", replace(preset, **{field.name: other})


def _one_log(
    path: Path, only: str | None, segmenter: Segmenter, rows: Sequence[Row], protocol: str, threads: int
) -> dict[str, Any]:
    with opened(path) as drive, bars(f"{path.name}  ") as progress:
        scenes = _with_truth(drive, path, only)
        primal = [primal_labels(scene, segmenter, progress) for scene in scenes]
        before = _score(drive, scenes, primal, protocol)
        lines: list[dict[str, Any]] = [{"variant": "primal", **_figures(before, before), "seconds": None}]
        for done, row in enumerate(rows):
            progress("variants", done, len(rows))
            began = time.perf_counter()
            refined = [_refined(drive, *pair, row.preset, threads) for pair in zip(scenes, primal, strict=True)]
            seconds = time.perf_counter() - began
            after = _score(drive, scenes, refined, protocol)
            ids = sum((follow_ids(drive, *pair) for pair in zip(scenes, refined, strict=True)), IdConsistency())
            lines.append({"variant": row.name, **_figures(before, after), "ids": ids.as_dict(), "seconds": seconds})
        progress("variants", len(rows), len(rows))
    return {"log": path.name, "scenes": [scene.name for scene in scenes], "rows": lines}


def _with_truth(drive: Drive, path: Path, only: str | None) -> list[Scene]:
    scenes = [scene for scene in drive.scenes if only in (None, scene.name)]
    if not scenes:
        known = ", ".join(scene.name for scene in drive.scenes[:10])
        raise LabelError(
            Problem("unknown-scene", "--scene", f"{path.name} has no scene '{only}'", f"Its scenes are: {known}.")
        )
    scenes = [scene for scene in scenes if any(scan.load_truth is not None for scan in scene.scans)]
    if not scenes:
        what = "it holds no truth, so no variant can be scored"
        raise LabelError(Problem("no-truth", path.name, what, "Name a log with annotated labels, or simulate one."))
    return scenes


def _refined(drive: Drive, scene: Scene, primal: list[ScanLabels], preset: Preset, threads: int) -> list[ScanLabels]:
    return refine_scene(scene, primal, preset, sensor_height=drive.sensor_height, threads=threads).labels


def _score(drive: Drive, scenes: Sequence[Scene], labels: Sequence[list[ScanLabels]], protocol: str) -> Quality:
    total = PanopticEvaluator(protocol)
    for scene, of_scene in zip(scenes, labels, strict=True):
        total.merge(evaluate_scene(drive, scene, of_scene, protocol))
    return total.quality()


def _figures(before: Quality, after: Quality) -> dict[str, Any]:
    """The means, and the class that lost most IoU against the primal labels."""
    change = {
        name: figures.iou - before.classes[name].iou for name, figures in after.classes.items() if figures.counted
    }
    worst = min(change, key=change.__getitem__, default=None)
    return {
        "pq": after.pq,
        "pq_things": after.pq_things,
        "miou": after.miou,
        "unlabelled": after.unlabelled,
        "worst_class": worst,
        "worst_iou_change": change[worst] if worst is not None else None,
        "classes": {name: asdict(after.classes[name]) for name in change},
    }


def _table(result: dict[str, Any], protocol: str) -> Table:
    table = Table(title=f"{result['log']}, protocol {protocol}, per cent", title_justify="left")
    table.add_column("variant", no_wrap=True)
    for column in ("PQ", "PQ\nthings", "mIoU", "one\nid", "worst\nIoU"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("of class")
    table.caption, table.caption_justify = (
        (
            f"one id: objects seen in {MIN_SCANS} scans or more that keep one id, of those matched twice.\n"
            "worst IoU: the largest loss of a class against the primal labels."
        ),
        "left",
    )
    for row in result["rows"]:
        one_id = row.get("ids", {}).get("one_id")
        cells = [_number(value) for value in (row["pq"], row["pq_things"], row["miou"], one_id)]
        table.add_row(row["variant"], *cells, _number(row["worst_iou_change"], "+"), row["worst_class"] or "")
    return table


def _number(value: float | None, sign: str = "") -> str:
    return "" if value is None else f"{value:{sign}.1f}"
