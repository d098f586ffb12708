"""``python -m l3ps_trainer``: the commands of ``l3ps`` that need torch, under their names there."""

from .command import app

app(prog_name="l3ps")
