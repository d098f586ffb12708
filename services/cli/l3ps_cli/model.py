"""``l3ps model``: what can be done with model bundles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from l3ps.segment.check import MEMORY, SECONDS, BundleReport, check_bundle
from l3ps_cli.errors import clear_errors
from l3ps_cli.trainer import hand_over

app = typer.Typer(help="Make and check model bundles.", no_args_is_help=True)


@app.callback()
def model() -> None:
    """Make and check model bundles."""


@app.command(
    "import-pastel",
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
)
def import_pastel(context: typer.Context) -> None:
    """Turn the authors' published checkpoints into a bundle (needs the trainer: make setup-trainer)."""
    hand_over("model", "import-pastel", arguments=context.args)


@app.command()
def check(
    bundle: Annotated[Path, typer.Argument(help="Model bundle: directory or zip.")],
    threads: Annotated[int, typer.Option(min=1, max=256)] = 2,
    memory: Annotated[int, typer.Option(min=256, help="MB that one image may take.")] = MEMORY >> 20,
    seconds: Annotated[float, typer.Option(min=1, help="That the trial may take.")] = SECONDS,
    as_json: Annotated[bool, typer.Option("--json", help="Print what is inside as JSON.")] = False,
) -> None:
    """Say what is in a bundle, and whether the engine can use it: it is read and runs one image in its own process.

    Refused are graphs with custom operators or functions, weights outside the bundle, absurd sizes, inputs and outputs
    other than model.json's, and what does not come through the trial.
    """
    with clear_errors():
        report = check_bundle(bundle, threads=threads, memory=memory << 20, seconds=seconds)
    if as_json:
        typer.echo(report.model_dump_json())
    else:
        typer.echo(_said(report))


def _said(report: BundleReport) -> str:
    lines = [f"{report.name}: usable"]
    for graph in report.graphs:
        numbers = "int8" if graph.int8 else "float"
        facts = f"{graph.bytes / 1e6:.1f} MB, opset {graph.opset}, {graph.nodes} operators, {numbers}"
        lines.append(f"{graph.file} (preset {graph.preset}): {facts}, {graph.seconds:.2f} s an image")
        lines.append(f"  input {'×'.join(map(str, graph.input))}")
        lines += [f"  output {name} {'×'.join(map(str, shape))}" for name, shape in graph.outputs.items()]
    lines += [f"{name}: {size / 1e6:.1f} MB of weights" for name, size in report.data.items()]
    lines.append(f"{len(report.classes)} classes: {', '.join(report.classes)}")
    return "\n".join(lines)
