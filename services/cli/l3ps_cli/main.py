"""The ``l3ps`` command: one file a subcommand, imported when it is asked for.

The method's packages take about four seconds of CPU time to import, which commands that only talk to a service, and
the process that only watches over the embedded stack, need not spend.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup

COMMANDS = (
    "label", "evaluate", "draw", "simulate", "simulate-images", "bench", "ablate", "train", "model", "up", "submit",
    "jobs", "download", "drives", "models", "uploads", "submit-training", "trainings", "keys", "webhooks", "whoami",
    "demo",
)  # fmt: skip
"""In the order of ``l3ps --help``. Module ``l3ps_cli.NAME`` has a function of that name, or ``app`` with commands; a
hyphen of the name is an underscore there. ``CONTEXT`` holds the settings that the function wants of its own."""


class _OnDemand(TyperGroup):
    """A group whose commands are imported when named, or all of them for the help."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One command, or None when there is none of that name."""
        if cmd_name not in COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        module = import_module(f"l3ps_cli.{name}")
        if hasattr(module, "app"):
            group = typer.main.get_group(module.app)
            group.name = cmd_name
            return group
        alone = typer.Typer(add_completion=False)
        alone.command(cmd_name, context_settings=getattr(module, "CONTEXT", None))(getattr(module, name))
        return typer.main.get_command(alone)


app = typer.Typer(
    cls=_OnDemand,
    name="l3ps",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


@app.callback()
def l3ps() -> None:
    """LiDAR label engine: drive logs in, panoptic-labelled point clouds out, on CPUs alone."""


if __name__ == "__main__":
    app()
