"""Checkpoints that survive a kill at any moment, and belong to one set of settings."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any, cast

import torch

from l3ps.errors import InputError, Problem

NAME = "checkpoint.pt"


def save(folder: Path, content: dict[str, Any], settings: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all.

    Args:
        folder: of the work in progress.
        content: tensors and plain values.
        settings: everything that decides the weights, as plain data.
    """
    partial = folder / f"{NAME}.partial"
    with partial.open("wb") as file:
        torch.save({**content, "settings": json.dumps(settings, sort_keys=True)}, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(folder / NAME)


def load(folder: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The checkpoint in a folder, or None.

    Raises:
        InputError: it is of other settings, or damaged.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    remedy = "Add --fresh to start over, or name another folder with --out."
    try:
        content = cast(dict[str, Any], torch.load(path, map_location="cpu", weights_only=True))
        before = json.loads(content.pop("settings"))
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, ValueError) as error:
        what = "the checkpoint cannot be read"
        raise InputError(Problem("bad-checkpoint", str(path), what, remedy)) from error
    now = json.loads(json.dumps(settings))
    different = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    if different:
        what = f"a training with other settings was begun here ({', '.join(different)} differ)"
        raise InputError(Problem("other-settings", str(folder.parent), what, remedy))
    return content
