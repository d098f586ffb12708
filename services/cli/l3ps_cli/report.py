"""A job's figures as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from l3ps_cli.watch import stages_of


def quality_table(quality: dict[str, Any]) -> Table:
    """Per class and mean, primal beside refined, per cent; the classes that the means run over.

    Args:
        quality: a job's ``quality``: ``protocol``, ``primal`` and ``refined``, each with ``pq``, ``miou``, ``classes``.
    """
    primal, refined = quality["primal"], quality["refined"]
    title = f"Quality against the log's truth, protocol {quality['protocol']}, per cent"
    table = Table(title=title, title_justify="left")
    table.add_column("class", no_wrap=True)
    for name in ("PQ\nprimal", "PQ\nrefined", "", "IoU\nprimal", "IoU\nrefined", ""):
        table.add_column(name, justify="right", no_wrap=True)
    for name in _counted(primal, refined):
        before, after = primal["classes"].get(name, {}), refined["classes"].get(name, {})
        table.add_row(name, *_pair(before.get("pq"), after.get("pq")), *_pair(before.get("iou"), after.get("iou")))
    table.add_section()
    things = _pair(primal.get("pq_things"), refined.get("pq_things"))
    table.add_row("mean, things", *things, "", "", "")
    table.caption, table.caption_justify = _remarks(primal, refined), "left"
    mean = _pair(primal["pq"], refined["pq"]) + _pair(primal["miou"], refined["miou"])
    table.add_row("mean", *mean, style="bold")
    return table


def _remarks(primal: dict[str, Any], refined: dict[str, Any]) -> str:
    """What a reader must know to judge the figures."""
    void = [side.get("unlabelled") for side in (primal, refined)]
    remarks = []
    if None not in void:
        remarks.append(f"Points with truth that got no label: {void[0]:.1f} % primal, {void[1]:.1f} % refined.")
    if refined["pq"] is None and _counted(primal, refined):
        remarks.append("No mean PQ: the truth has things without instances.")
    return "\n".join(remarks)


def stage_table(job: Mapping[str, Any]) -> Table:
    """What each stage of a job took, its steps indented below it."""
    table = Table("stage", "state", title="Stages", title_justify="left")
    for name in ("seconds", "CPU s", "peak MB"):
        table.add_column(name, justify="right")
    for label, stage in stages_of(job):
        state = "from store" if stage.get("cached") else stage["state"]
        table.add_row(label, state, *(_number(stage.get(key)) for key in ("seconds", "cpu_seconds", "peak_mb")))
        for step in stage.get("steps") or []:
            table.add_row(f"  {step['name']}", "", _number(step["seconds"]), "", _number(step["peak_mb"]), style="dim")
    return table


def _counted(primal: dict[str, Any], refined: dict[str, Any]) -> list[str]:
    """Classes with a truth segment that counts on either side, in the label space's order."""
    names = list(dict.fromkeys([*primal["classes"], *refined["classes"]]))
    figures = [[side["classes"].get(name) or {} for side in (primal, refined)] for name in names]
    has_truth = [any(f.get("truth_segments") or f.get("tp") for f in pair) for pair in figures]
    return [name for name, counted in zip(names, has_truth, strict=True) if counted]


def _pair(before: float | None, after: float | None) -> tuple[str, str, str]:
    if before is None or after is None:
        return _number(before), _number(after), ""
    gain = after - before
    color = "green" if gain > 0.05 else "red" if gain < -0.05 else "dim"
    return _number(before), _number(after), f"[{color}]{gain:+.1f}[/]"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
