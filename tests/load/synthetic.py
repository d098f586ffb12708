"""A catalog as a fleet leaves it behind: many finished jobs, written straight into the tables."""

from __future__ import annotations

import random
from datetime import timedelta
from typing import Any

from sqlalchemy import insert

from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    AttemptRow,
    Catalog,
    DriveRow,
    JobRow,
    ModelFiguresRow,
    ModelRow,
    SceneRow,
    StageRow,
    StepRow,
)
from l3ps_platform.ids import new_id

CLASSES = ("barrier", "bicycle", "bus", "car", "truck", "person", "road", "sidewalk", "terrain", "building", "tree")
STEPS = ("accumulate", "ground", "cluster", "vote", "instances")
BATCH = 500


def fill(catalog: Catalog, jobs: int, *, seed: int = 1) -> None:
    """Add finished jobs of one scene each, three stages a job, to twenty drives and five models."""
    draw = random.Random(seed)
    with catalog.transaction() as tx:
        own = {"project_id": DEFAULT_PROJECT, "filename": "x.zip", "sha256": "a" * 64, "size": 1000, "state": "ready"}
        drives = [own | {"id": new_id("drv"), "name": f"drive {n}", "created_at": tx.now} for n in range(20)]
        models = [own | {"id": new_id("mdl"), "name": f"model-{n}", "created_at": tx.now} for n in range(5)]
        tx.session.execute(insert(DriveRow), drives)
        tx.session.execute(insert(ModelRow), models)
    for start in range(0, jobs, BATCH):
        with catalog.transaction() as tx:
            rows: dict[type, list[dict[str, Any]]] = {
                kind: [] for kind in (JobRow, SceneRow, StageRow, StepRow, AttemptRow)
            }
            for number in range(start, min(start + BATCH, jobs)):
                ended = tx.now - timedelta(seconds=(jobs - number) * 10)
                _job(rows, draw, drives[number % 20]["id"], models[number % 5]["id"], ended)
            for kind, values in rows.items():
                tx.session.execute(insert(kind), values)
    with catalog.transaction() as tx:
        for model in models:
            row = {"project_id": DEFAULT_PROJECT, "model_id": model["id"], "job_id": "job_x", "finished_at": tx.now}
            tx.session.execute(insert(ModelFiguresRow), [row | {"kind": "nuscenes", "figures": _quality(draw)}])


def _job(rows: dict[type, list[dict[str, Any]]], draw: random.Random, drive: str, model: str, ended: Any) -> None:
    job, scene = new_id("job"), new_id("scn")
    state = draw.choices(("succeeded", "failed", "cancelled"), (90, 8, 2))[0]
    times = {
        "created_at": ended - timedelta(minutes=5),
        "started_at": ended - timedelta(minutes=4),
        "finished_at": ended,
    }
    settings = {"preset": "best", "formats": ["nuscenes"], "protocol": "nuscenes", "skip_bad_scans": False}
    rows[JobRow].append(
        times
        | {"id": job, "project_id": DEFAULT_PROJECT, "drive_id": drive, "model_id": model, "settings": settings}
        | {"state": state, "cancel_requested": False, "quality": _quality(draw) if draw.random() < 0.1 else None}
    )
    stage_state = {"succeeded": "done"}.get(state, state)
    rows[SceneRow].append(
        {"id": scene, "job_id": job, "name": "s", "position": 0, "scans": 40, "points": 1_000_000, "state": stage_state}
    )
    for name, queue in (("segment", "segment"), ("refine", "refine"), ("publish", "refine")):
        stage = new_id("stg")
        cost = {
            "seconds": draw.lognormvariate(3, 1),
            "cpu_seconds": 30.0,
            "peak_mb": 800.0,
            "scans": 40,
            "points": 10**6,
        }
        when = {"started_at": ended - timedelta(minutes=2), "finished_at": ended}
        row = {"id": stage, "job_id": job, "scene_id": None if name == "publish" else scene, "name": name}
        rows[StageRow].append(row | cost | when | {"queue": queue, "state": stage_state, "attempt": 1, "cached": False})
        rows[AttemptRow].append(
            cost
            | when
            | {
                "project_id": DEFAULT_PROJECT,
                "stage_id": stage,
                "job_id": job,
                "name": name,
                "attempt": 1,
                "owner": "w",
            }
            | {
                "outcome": stage_state,
                "cause": "crashed" if state == "failed" else None,
                "bytes": 10**6,
                "cached": False,
            }
        )
        if name == "refine":
            rows[StepRow].extend({"stage_id": stage, "name": step, "seconds": 2.0, "peak_mb": 500.0} for step in STEPS)


def _quality(draw: random.Random) -> dict[str, Any]:
    def side() -> dict[str, Any]:
        of_class = {name: draw.uniform(20, 80) for name in ("pq", "sq", "rq", "iou")} | {"counted": True}
        means = {name: draw.uniform(20, 80) for name in ("pq", "sq", "rq", "miou")}
        return means | {"classes": dict.fromkeys(CLASSES, of_class)}

    return {"protocol": "nuscenes", "primal": side(), "refined": side()}
