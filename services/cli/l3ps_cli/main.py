"""The ``l3ps`` command: one file a subcommand."""

from __future__ import annotations

import typer

from l3ps_cli import bench
from l3ps_cli.demo import demo
from l3ps_cli.download import download
from l3ps_cli.draw import draw
from l3ps_cli.evaluate import evaluate
from l3ps_cli.jobs import jobs
from l3ps_cli.label import label
from l3ps_cli.simulate import simulate
from l3ps_cli.submit import submit
from l3ps_cli.up import up

app = typer.Typer(
    name="l3ps",
    help="LiDAR label engine: drive logs in, panoptic-labelled point clouds out, on CPUs alone.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
for command in (label, evaluate, draw, simulate, up, submit, jobs, download, demo):
    app.command()(command)
app.add_typer(bench.app, name="bench")

if __name__ == "__main__":
    app()
