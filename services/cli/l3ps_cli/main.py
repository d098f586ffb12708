"""The ``l3ps`` command: one file a subcommand."""

from __future__ import annotations

import typer

from l3ps_cli import bench
from l3ps_cli.label import label

app = typer.Typer(
    help="Panoptic labels for LiDAR drive logs, on CPUs alone.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command()(label)
app.add_typer(bench.app, name="bench")
