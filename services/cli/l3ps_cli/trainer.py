"""Handing a command over to the trainer. The command line itself carries no torch."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import NoReturn

from l3ps_cli.errors import BAD_INPUT, fail

NEEDED = ("l3ps_trainer", "torch", "timm")


def missing() -> list[str]:
    """The packages that training needs and that are not installed here; they are looked for and not imported."""
    return [name for name in NEEDED if find_spec(name) is None]


def hand_over(*command: str, arguments: Sequence[str]) -> NoReturn:
    """Replace this process by the trainer's command; without a trainer, end with how to install it."""
    if names := missing():
        fail(f"The trainer is not installed here ({', '.join(names)} missing). Run: make setup-trainer.", BAD_INPUT)
    os.execv(sys.executable, [sys.executable, "-m", "l3ps_trainer", *command, *arguments])
