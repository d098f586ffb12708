"""A scene's refined labels, the label files of both sides, poses, and the scene's quality.

The output's key says what was computed, and two machines may round it differently. So the files lie in a folder named
by a digest of them all: of two workers that compute the same at once, or one that goes on after it was given up, none
writes into the other's files, and the checksums in whichever ``scene.json`` is last are those of the files it names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from l3ps.costs import CostBook
from l3ps.drivelog import Drive, Scene
from l3ps.errors import ProcessingError
from l3ps.evaluate import evaluate_scene
from l3ps.labels import ScanLabels, write_poses, write_scene
from l3ps.pipeline import REFINE_STAGES, refine_scene
from l3ps.progress import Progress
from l3ps.refine.chunks import BYTES_A_POINT
from l3ps_platform import workflow
from l3ps_platform.catalog import Json
from l3ps_platform.errors import ObjectMissing
from l3ps_platform.objects import segment as key_segment
from l3ps_worker.arrays import read_labels
from l3ps_worker.context import Context
from l3ps_worker.keys import refine_key
from l3ps_worker.outputs import is_whole, pin
from l3ps_worker.work import Done, SceneWork, opened_scene, scene_work, sha256_of

log = structlog.get_logger(__name__)

STEPS = (*REFINE_STAGES, "write", "evaluate", "store")
SCENE_MANIFEST = "scene.json"


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """A file, and the format and scan it belongs to; None for those of every format, or of several scans."""

    path: Path
    format: str | None = None
    scan: str | None = None


def refine(context: Context, claim: workflow.Claim, progress: Progress) -> Done:
    """Refine, write, evaluate and store one scene; its ``scene.json`` is stored last and names all the rest."""
    work = scene_work(context, claim)
    budget = max(1, context.settings.refine_bytes // BYTES_A_POINT)
    max_points = budget if work.scene.points > budget else None
    wanted = work.job.settings
    assert work.primal is not None, "a refine stage is queued when its scene's segment stage is done"
    prefix = refine_key(work.primal, work.preset, wanted["formats"], wanted["protocol"], max_points)
    manifest_key = f"{prefix}/{SCENE_MANIFEST}"
    pin(context, claim, prefix, progress)
    with suppress(ObjectMissing):
        stored: Json = json.loads(context.store.get_bytes(manifest_key))
        if is_whole(context.store, prefix, stored["files"]):
            return _done(manifest_key, stored, work, cached=True)
        log.warning("labels are not whole in the store, computing them anew", prefix=prefix)
    book = CostBook()
    with opened_scene(context, work, progress) as (drive, scene), context.scratch.workdir() as folder:
        primal = _primal(context, work.primal, folder)
        refined = refine_scene(
            scene,
            primal,
            work.preset,
            sensor_height=drive.sensor_height,
            threads=context.settings.threads,
            progress=progress,
            max_points=max_points,
        )
        sides = {"primal": primal, "refined": refined.labels}
        out = folder / "out"
        with book.span("write"):
            files = _write(out, wanted["formats"], scene, sides, refined.poses, progress)
        with book.span("evaluate"):
            quality = _evaluate(drive, scene, sides, wanted["protocol"], progress)
        with book.span("store"):
            entries = _store(context, prefix, out, files, progress)
    for problem in refined.warnings:
        log.warning("scene doubtful", scene=work.scene.name, problem=str(problem))
    manifest = {
        "scene": work.scene.name,
        "files": entries,
        "quality": quality,
        "estimates": [estimate.as_dict() for estimate in refined.estimates],
        "warnings": [problem.as_dict() for problem in refined.warnings],
    }
    # Given up meanwhile, this attempt may have seen its files deleted again: then nothing may vouch for them.
    pin(context, claim, prefix, progress)
    context.store.put_bytes(manifest_key, json.dumps(manifest, indent=1).encode())
    costs = {**refined.costs, **book.stages}
    steps = {name: (cost.seconds, cost.peak_mb) for name, cost in costs.items()}
    return _done(manifest_key, manifest, work, steps=steps)


def _done(
    key: str,
    manifest: Json,
    work: SceneWork,
    *,
    cached: bool = False,
    steps: dict[str, tuple[float, float]] | None = None,
) -> Done:
    quality = manifest["quality"]

    def finish(tx: workflow.Transaction, claim: workflow.Claim, cost: workflow.Cost) -> None:
        workflow.complete(tx, claim, cost, output_key=key, quality=quality)
        workflow.note_output(tx, key.rpartition("/")[0], sum(file["size"] for file in manifest["files"]))

    stored = sum(file["size"] for file in manifest["files"])
    return Done(finish, work.scene.scans, work.scene.points, stored, cached=cached, steps=steps or {})


def _primal(context: Context, key: str, folder: Path) -> list[ScanLabels]:
    try:
        context.store.get_file(key, folder / "primal.npz")
    except ObjectMissing:
        raise ProcessingError("the scene's primal labels are gone from the store: retry the job") from None
    return read_labels(folder / "primal.npz")


def _write(
    out: Path,
    formats: Sequence[str],
    scene: Scene,
    sides: dict[str, list[ScanLabels]],
    poses: NDArray[np.float64],
    progress: Progress,
) -> list[WrittenFile]:
    """Write all files below ``out``."""
    files: list[WrittenFile] = []
    tasks = [(side, format) for side in sides for format in formats]
    for done, (side, format) in enumerate(tasks, start=1):
        written = write_scene(out / side, format, scene, sides[side])  # type: ignore[arg-type]
        each = max(1, len(written) // max(1, len(sides[side])))  # in the order of the scans, as many for each
        files += [WrittenFile(path, format, sides[side][at // each].token) for at, path in enumerate(written)]
        progress("write", done, len(tasks))
    files += [WrittenFile(path) for path in write_poses(out, [(scene, poses)])]
    return files


def _evaluate(
    drive: Drive, scene: Scene, sides: dict[str, list[ScanLabels]], protocol: str, progress: Progress
) -> Json | None:
    """The evaluators' states of both sides, or None where the scene has no truth."""
    if not any(scan.load_truth is not None for scan in scene.scans):
        return None
    states: dict[str, Any] = {"protocol": protocol}
    for done, (side, labels) in enumerate(sides.items(), start=1):
        states[side] = evaluate_scene(drive, scene, labels, protocol).state()
        progress("evaluate", done, len(sides))
    return states


def _store(context: Context, prefix: str, out: Path, files: Sequence[WrittenFile], progress: Progress) -> list[Json]:
    entries: list[Json] = [
        {
            "path": file.path.relative_to(out).as_posix(),
            "format": file.format,
            "scan": file.scan,
            "size": file.path.stat().st_size,
            "sha256": sha256_of(file.path),
        }
        for file in files
    ]
    contents = "".join(f"{entry['sha256']}  {entry['path']}\n" for entry in entries)
    folder = f"{prefix}/{hashlib.sha256(contents.encode()).hexdigest()[:16]}"
    for done, (file, entry) in enumerate(zip(files, entries, strict=True), start=1):
        entry["key"] = "/".join([folder, *map(key_segment, entry["path"].split("/"))])
        context.store.put_file(entry["key"], file.path)
        progress("store", done, len(files))
    return entries
