"""What needs the trainer is handed over to it, or told to be missing."""

import os
import sys

import pytest
from typer.testing import CliRunner

from l3ps_cli import trainer
from l3ps_cli.main import app


@pytest.mark.parametrize(
    "typed",
    [
        ["train", "photos", "--backbone", "dinov2-s", "--out", "m", "--help"],
        ["model", "import-pastel", "a.ckpt", "b.ckpt", "--out", "m", "--help"],
    ],
)
def test_every_option_reaches_the_trainer(monkeypatch, typed):
    calls = []
    monkeypatch.setattr(os, "execv", lambda path, arguments: calls.append((path, arguments)))
    assert CliRunner().invoke(app, typed).exit_code == 0
    assert calls == [(sys.executable, [sys.executable, "-m", "l3ps_trainer", *typed])]


def test_without_the_trainer_the_user_learns_how_to_get_it(monkeypatch):
    monkeypatch.setattr(trainer, "NEEDED", ("l3ps_trainer", "no_such_package"))
    result = CliRunner().invoke(app, ["train", "photos"])
    assert result.exit_code == 2
    assert "no_such_package missing" in result.stderr
    assert "make setup-trainer" in result.stderr
