"""The last stage of a job: one manifest over its scenes, and the quality of the whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable

from l3ps.errors import ProcessingError
from l3ps.evaluate import PanopticEvaluator, mean_estimates
from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.catalog import Json, StageName, StageRow, StageState, bundles, jobs, stages
from l3ps_platform.errors import ObjectMissing
from l3ps_worker.context import Context
from l3ps_worker.outputs import is_whole
from l3ps_worker.work import Done

JOINED = ("poses.txt", "scans.txt")
"""Files that every scene has and a job has once: its scenes' rows, one scene after the other."""


def publish(context: Context, claim: workflow.Claim, progress: Progress) -> Done:
    """Write ``jobs/<id>/manifest.json``, which names every file of the job's finished scenes, last of all."""
    assert claim.job_id is not None
    with context.catalog.reading() as session:
        job = jobs.get(session, claim.job_id)
        model = bundles.get(session, job.model_id)
        scenes = jobs.scenes(session, job.id)
        refined = {stage.scene_id: stage for stage in stages.of_job(session, job.id) if _is_refined(stage)}
    prefix = f"jobs/{job.id}"
    finished = [(scene, refined[scene.id]) for scene in scenes if scene.id in refined]
    files: list[Json] = []
    joined = dict.fromkeys(JOINED, b"")
    judged: dict[str, Json] = {}
    qualities: list[Json | None] = []
    for done, (scene, stage) in enumerate(finished, start=1):
        scene_manifest = _scene_manifest(context, scene.name, stage.output_key or "")
        for file in scene_manifest["files"]:
            if file["path"] in joined:
                joined[file["path"]] += context.store.get_bytes(file["key"])
            else:
                files.append({**file, "scene": scene.name})
        judged[scene.name] = {key: scene_manifest.get(key, []) for key in ("estimates", "warnings")}
        qualities.append(scene_manifest.get("quality", scene.quality))
        progress("publish", done, len(finished))
    for path, data in joined.items():
        key = f"{prefix}/{path}"
        context.store.put_bytes(key, data)
        sha256 = hashlib.sha256(data).hexdigest()
        files.append({"path": path, "format": None, "size": len(data), "sha256": sha256, "key": key})
    quality = job_quality(qualities)
    estimates = mean_estimates(scan for scene in judged.values() for scan in scene["estimates"])
    manifest = {
        "job_id": job.id,
        "drive_id": job.drive_id,
        "model": model.name,
        "settings": job.settings,
        "scenes": [
            {"name": s.name, "state": s.state.value, "scans": s.scans, "points": s.points, **judged.get(s.name, {})}
            for s in scenes
        ],
        "quality": quality,
        "files": files,
    }
    manifest_key = f"{prefix}/manifest.json"
    context.store.put_bytes(manifest_key, json.dumps(manifest, indent=1).encode())
    return Done(
        lambda tx, claim, cost: workflow.complete(
            tx, claim, cost, output_key=manifest_key, quality=quality, estimates=estimates
        ),
        scans=sum(scene.scans for scene, _ in finished),
        points=sum(scene.points for scene, _ in finished),
    )


def _scene_manifest(context: Context, scene: str, key: str) -> Json:
    """What a scene's refine stage stored. ProcessingError where it is not all there: a retry makes it anew."""
    try:
        manifest: Json = json.loads(context.store.get_bytes(key))
        if is_whole(context.store, key.rpartition("/")[0], manifest["files"]):
            return manifest
        context.store.delete(key)  # by it the retry sees what is there
    except ObjectMissing:
        pass
    raise ProcessingError(f"labels of scene {scene!r} are gone from the store: retry the job")


def job_quality(scenes: Iterable[Json | None]) -> Json | None:
    """The figures over all scenes with truth, from their evaluators' counts; None where there is no truth."""
    merged: dict[str, PanopticEvaluator] = {}
    protocol = ""
    for states in scenes:
        if states is None:
            continue
        protocol = states["protocol"]
        for side in ("primal", "refined"):
            evaluator = PanopticEvaluator.from_state(states[side])
            if side in merged:
                merged[side].merge(evaluator)
            else:
                merged[side] = evaluator
    if not merged:
        return None
    return {"protocol": protocol, **{side: evaluator.quality().as_dict() for side, evaluator in merged.items()}}


def _is_refined(stage: StageRow) -> bool:
    return stage.name is StageName.REFINE and stage.state is StageState.DONE
