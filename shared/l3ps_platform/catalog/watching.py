"""Queries for those who watch jobs: three of them, however many jobs."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import JobRow, SceneRow, StageRow
from l3ps_platform.catalog.states import JobState, StageState


def progress(session: Session, job_ids: Collection[str]) -> dict[str, Json]:
    """How far each job is.

    ``{"id", "state", "progress", "stages": {name: {state: count}}, "running": [{"id", "name", "scene", "attempt",
    "step", "done", "total", "fraction"}…]}``: ``progress`` is the share of the stages' work that is done, 0..1, and
    only what runs is told one by one, so that a watcher of a job of a thousand scenes is sent some hundred bytes.
    """
    rows = session.execute(select(JobRow.id, JobRow.state, JobRow.drive_id).where(JobRow.id.in_(job_ids))).all()
    found: dict[str, Json] = {
        id: {"id": id, "state": state.value, "progress": 0.0, "stages": {}, "running": []} for id, state, _ in rows
    }
    done: dict[str, float] = dict.fromkeys(found, 0.0)
    total: dict[str, int] = dict.fromkeys(found, 0)
    counts = select(StageRow.job_id, StageRow.name, StageRow.state, func.count(), func.sum(StageRow.fraction))
    for id, name, stage_state, count, fractions in session.execute(
        counts.where(StageRow.job_id.in_(found)).group_by(StageRow.job_id, StageRow.name, StageRow.state)
    ):
        assert id is not None
        found[id]["stages"].setdefault(name.value, {})[stage_state.value] = count
        total[id] += count
        done[id] += count if stage_state.final else float(fractions) if stage_state is StageState.RUNNING else 0.0
    for id, state, _ in rows:
        share = done[id] / total[id] if total[id] else 0.0
        found[id]["progress"] = 1.0 if state is JobState.SUCCEEDED else round(min(1.0, share), 4)
    # The check of the drive is no stage of the job, but what a job that waits for it is waiting for.
    checked_for: dict[str, list[str]] = {}
    for id, state, drive_id in rows:
        if state is JobState.QUEUED:
            checked_for.setdefault(drive_id, []).append(id)
    for row in _running(session, found, checked_for):
        for id in [row.job_id] if row.job_id is not None else checked_for[row.drive_id]:
            found[id]["running"].append(
                {
                    **{"id": row.id, "name": row.name.value, "scene": row.scene, "attempt": row.attempt},
                    **{"step": row.progress_step, "done": row.progress_done, "total": row.progress_total},
                    "fraction": round(row.fraction, 4),
                }
            )
    return found


def _running(session: Session, job_ids: Collection[str], drive_ids: Collection[str]) -> list[Any]:
    what = (StageRow.id, StageRow.job_id, StageRow.drive_id, StageRow.name, StageRow.attempt, StageRow.fraction)
    how_far = (StageRow.progress_step, StageRow.progress_done, StageRow.progress_total)
    query = select(*what, *how_far, SceneRow.name.label("scene")).outerjoin(SceneRow, SceneRow.id == StageRow.scene_id)
    theirs = or_(StageRow.job_id.in_(job_ids), StageRow.drive_id.in_(drive_ids))
    return list(session.execute(query.where(StageRow.state == StageState.RUNNING, theirs).order_by(StageRow.id)))
