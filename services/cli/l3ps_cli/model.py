"""``l3ps model``: what can be done with model bundles."""

from __future__ import annotations

import typer

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
    hand_over("import-pastel", context.args)
