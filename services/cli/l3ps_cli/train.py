"""``l3ps train``: hands over to the trainer, which lives in a package of its own because of torch."""

from __future__ import annotations

import typer

from l3ps_cli.trainer import hand_over

CONTEXT = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
"""Everything behind the command's name, --help too, is the trainer's."""


def train(context: typer.Context) -> None:
    """Train a model on few annotated images (needs the trainer: make setup-trainer)."""
    hand_over("train", arguments=context.args)
