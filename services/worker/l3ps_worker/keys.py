"""Content-addressed keys of stage outputs: the same inputs, settings and code give the same key.

A job that asks for what is there already gets it at once, and a changed vote rule runs again from the stored primal
labels, because the key of a segment stage covers only the code and the settings that segmentation uses.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import l3ps
from l3ps.errors import ProcessingError
from l3ps.presets import Preset
from l3ps.refine.cluster import build
from l3ps.segment.presets import SegmentPreset
from l3ps_worker.trainer import TRAINER

_ROOT = Path(l3ps.__path__[0])
_SEGMENTATION = ("segment", "drivelog", "project.py", "geometry.py", "taxonomy.py", "pipeline.py", "labels/types.py")
_BUNDLE = ("segment", "taxonomy.py")
_LAYOUT = 2  # of scene.json: raised when it tells more than before, so that older ones are not taken for it
_NOT_METHOD = ("simulate", "errors.py", "progress.py", "costs.py")


def segment_key(
    project: str, drive_sha256: str, model_sha256: str, scene: str, preset: Preset, look: SegmentPreset, *, skip: bool
) -> str:
    """Key of a scene's primal labels; ``project`` by its id."""
    return _key(
        "segment",
        project,
        drive=drive_sha256,
        model=model_sha256,
        scene=scene,
        min_area=preset.min_area,
        look=look.as_dict(),
        skip=skip,
        code=code_version(_SEGMENTATION),
    )


def refine_key(
    primal_key: str, preset: Preset, formats: list[str], protocol: str, max_points: int | None = None
) -> str:
    """Key prefix of a scene's refined labels and label files; ``max_points`` where it is refined in chunks.

    Args:
        primal_key: of the scene's primal labels; it names the project too.
        preset, formats, protocol: the job's.
        max_points: the size of the chunks.
    """
    chunks = {} if max_points is None else {"max_points": max_points}
    return _key(
        "refine",
        primal_key.split("/")[1],
        layout=_LAYOUT,
        **chunks,
        primal=primal_key,
        preset=preset.as_dict(),
        formats=sorted(formats),
        protocol=protocol,
        code=code_version(),
    )


def train_key(project: str, annotations: list[str], settings: Mapping[str, Any], backbone: str) -> str:
    """Key prefix of a trained bundle and its checkpoint, whatever the model is called.

    Args:
        project: its id.
        annotations: digests of the archives, those to measure on last.
        settings: of the training.
        backbone: digest of the backbone's files.
    """
    code = [trainer_version(), code_version(_BUNDLE)]
    return _key("train", project, annotations=annotations, settings=dict(settings), backbone=backbone, code=code)


@cache
def trainer_version() -> str:
    """A digest of the trainer's source, which is looked up and not imported. ProcessingError where there is none."""
    found = importlib.util.find_spec(TRAINER)
    if found is None or found.origin is None:
        raise ProcessingError("this worker has no trainer: install l3ps-trainer beside it, or stop serving queue train")
    return _digest(Path(found.origin).parent, lambda _: True).hexdigest()


@cache
def code_version(parts: tuple[str, ...] = ()) -> str:
    """A digest of the method's source: the given files and folders of ``l3ps``, or all that decides labels.

    All of it covers the build of the clustering too: the package that stands in for it decides ties otherwise.
    """
    digest = _digest(_ROOT, lambda path: _covered(path, parts))
    if not parts:
        digest.update(build().encode())
    return digest.hexdigest()


def _digest(root: Path, covered: Callable[[str], bool]) -> hashlib._Hash:
    digest = hashlib.sha256()
    for path in sorted(path for path in root.rglob("*.py") if covered(path.relative_to(root).as_posix())):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest


def _covered(path: str, parts: tuple[str, ...]) -> bool:
    def below(names: tuple[str, ...]) -> bool:
        return any(path == name or path.startswith(f"{name}/") for name in names)

    return below(parts) if parts else not below(_NOT_METHOD)


def _key(stage: str, project: str, **inputs: Any) -> str:
    # Below the project: what one project has computed never answers another one's job, not even by being quick.
    text = json.dumps({"stage": stage, **inputs}, sort_keys=True, separators=(",", ":"))
    return f"stages/{project}/{stage}-{hashlib.sha256(text.encode()).hexdigest()}"
