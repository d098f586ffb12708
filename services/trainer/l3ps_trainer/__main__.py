"""``python -m l3ps_trainer``."""

from .command import app

app(prog_name="l3ps_trainer")
