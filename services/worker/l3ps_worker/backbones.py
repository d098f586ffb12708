"""Pretrained backbones by name. Clients name them; where they lie is the service's business alone.

BACKBONES/NAME.onnx                     a graph that returns a feature map
BACKBONES/NAME/*.onnx                   the same network for several input sizes
BACKBONES/dinov2-s.pth                  weights of a network the trainer knows, or under the name their makers gave
BACKBONES/dinov2_vits14_pretrain.pth    them
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from l3ps.errors import InputError, Problem

SCRATCH = "scratch"
"""The trainer's own small encoder, trained from nothing; always there."""
_WEIGHTS = (".pth", ".pt", ".safetensors")
_OFFICIAL = re.compile(r"dinov2_vit([sblg])14(_reg4)?_pretrain")
_KNOWN = re.compile(r"dinov2-[sblg](-reg)?")
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Backbone:
    """A backbone that this worker has.

    Attributes:
        options: of the trainer's command line.
        digest: of its files; the same bytes give the same digest wherever they lie.
    """

    options: tuple[str, ...]
    digest: str


def find(folder: Path, name: str) -> Backbone:
    """The backbone of a name.

    Args:
        folder: where backbones lie; may be absent.
        name: as the client gave it.

    Raises:
        InputError: there is none of this name; says which there are.
    """
    known = dict(_listed(folder))
    if name == SCRATCH:
        return Backbone((f"--backbone={SCRATCH}",), "")
    if name not in known:
        names = ", ".join(sorted({*known, SCRATCH}))
        remedy = f"Use one of: {names}. Whoever runs the service adds others to the folder L3PS_BACKBONES_DIR."
        raise InputError(Problem("unknown-backbone", "backbone", f"this service has no backbone {name!r}", remedy))
    path = known[name].absolute()
    if path.suffix in _WEIGHTS:
        return Backbone((f"--backbone={name}", f"--weights={path}"), _digest(path))
    return Backbone((f"--backbone=onnx:{path}",), _digest(path))


def _listed(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix == ".onnx" and path.is_file():
            yield path.stem, path
        elif path.is_dir() and any(path.glob("*.onnx")):
            yield path.name, path
        elif path.suffix in _WEIGHTS and path.is_file():
            official = _OFFICIAL.fullmatch(path.stem)
            name = f"dinov2-{official[1]}{'-reg' if official[2] else ''}" if official else path.stem
            if _KNOWN.fullmatch(name):
                yield name, path


def _digest(path: Path) -> str:
    """Of a file, or of all files of a folder and what lies beside a graph under its name (weights, description)."""
    files = path.rglob("*") if path.is_dir() else path.parent.glob(f"{path.stem}.*")
    digest = hashlib.sha256()
    for file in sorted(file for file in files if file.is_file()):
        digest.update(file.name.encode() + b"\0")
        with file.open("rb") as source:
            while chunk := source.read(_CHUNK):
                digest.update(chunk)
    return digest.hexdigest()
