"""``l3ps evaluate``: how good labels are, by the truth in the log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from l3ps.drivelog import opened
from l3ps.evaluate import PROTOCOLS, ClassQuality, Quality, evaluate_drive
from l3ps.labels import LabelFolder, open_labels
from l3ps_cli.errors import BAD_INPUT, clear_errors, err, fail, out
from l3ps_cli.progress import bars


def evaluate(
    truth: Annotated[Path, typer.Option(help="Drive log with truth: a directory or archive.")],
    labels: Annotated[Path, typer.Option(help="Folder of label files, for example OUT/refined of `l3ps label`.")],
    protocol: Annotated[
        str | None, typer.Option(help=f"{', '.join(PROTOCOLS)}; default: that of the log's own truth.")
    ] = None,
    scene: Annotated[str | None, typer.Option(help="Only this scene.")] = None,
    skip_missing: Annotated[bool, typer.Option("--skip-missing", help="Leave out scans without labels.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON, in per cent.")] = False,
) -> None:
    """PQ, SQ, RQ and IoU of label files against a log's truth, per class and mean.

    Means run over the classes that have a truth segment of the protocol's minimum size, or a smaller one that was
    matched.
    """
    if protocol is not None and protocol not in PROTOCOLS:
        fail(f"--protocol: there is no '{protocol}'. Use one of {', '.join(PROTOCOLS)}.", BAD_INPUT)
    with clear_errors():
        folder = open_labels(labels)
        with opened(truth) as drive, bars() as progress:
            for problem in drive.problems:
                err.print(f"Warning: {problem}", style="yellow", markup=False, highlight=False)
            chosen = protocol or drive.truth_space
            quality = evaluate_drive(drive, folder, chosen, scene, progress, skip_missing=skip_missing)
    if as_json:
        typer.echo(json.dumps(quality.as_dict()))
    else:
        _show(quality, folder)


def _show(quality: Quality, labels: LabelFolder) -> None:
    rules = PROTOCOLS[quality.protocol]
    table = Table("class", title=f"Protocol {rules.name}, per cent", caption=rules.summary, title_justify="left")
    for column in ("PQ", "SQ", "RQ", "IoU", "TP", "FP", "FN"):
        table.add_column(column, justify="right")
    for name, figures in quality.classes.items():
        if figures.counted or figures.fp or figures.iou:
            table.add_row(*_row(name, figures), style=None if figures.counted else "dim")
    table.add_section()
    table.add_row("things", _number(quality.pq_things))
    table.add_row("stuff", _number(quality.pq_stuff))
    means = (quality.pq, quality.sq, quality.rq, quality.miou)
    table.add_row("mean", *map(_number, means), style="bold")
    out.print(table)
    for note in _notes(quality, labels):
        out.print(note, highlight=False)


def _notes(quality: Quality, labels: LabelFolder) -> list[str]:
    scans = "1 scan" if quality.scans == 1 else f"{quality.scans} scans"
    notes = [
        f"{scans}, {quality.points:,} points with truth, {quality.unlabelled:.1f} % of them unlabelled. "
        "Dim classes have no truth segment that counts and are in no mean."
    ]
    if quality.things_unscored:
        notes.append(f"No PQ for {', '.join(quality.things_unscored)}: there are no instances to match.")
    if labels.format != PROTOCOLS[quality.protocol].space.name:
        notes.append(
            f"The labels are in {labels.format} classes: classes that these do not tell apart count as missed."
        )
    return notes


def _row(name: str, figures: ClassQuality) -> list[str]:
    shares = (figures.pq, figures.sq, figures.rq, figures.iou)
    counts = (figures.tp, figures.fp, figures.fn)
    return [name, *map(_number, shares), *("–" if count is None else f"{count:,}" for count in counts)]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
