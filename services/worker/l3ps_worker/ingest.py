"""The first stage of an upload: is it a drive log, or a model, that a job can use?"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import structlog

from l3ps.drivelog import Drive, open_drive, validate, without_bad_scans
from l3ps.errors import InputError, Problem
from l3ps.progress import Progress, silent
from l3ps.segment.check import check_bundle
from l3ps_platform import workflow
from l3ps_platform.catalog import DriveRow, Json, ModelRow, bundles, drives
from l3ps_platform.errors import StoreError
from l3ps_worker.context import Context
from l3ps_worker.fetching import Fetched, check_sha256, download, fetch
from l3ps_worker.work import Done

log = structlog.get_logger(__name__)


def ingest(context: Context, claim: workflow.Claim, progress: Progress) -> Done:
    """Check an uploaded drive or model; a bad one is rejected with its problems and its archive deleted."""
    if claim.drive_id is not None:
        with context.catalog.reading() as session:
            drive = drives.many(session, [claim.drive_id])[claim.drive_id]
        return _ingest_drive(
            context, drive, progress
        )  # an open session would hold back vacuum and migrations for hours
    assert claim.model_id is not None
    with context.catalog.reading() as session:
        model = bundles.get(session, claim.model_id)
    return _ingest_model(context, model, progress)


def _ingest_drive(context: Context, row: DriveRow, progress: Progress) -> Done:
    with context.scratch.workdir() as folder:
        fetched: Fetched | None = None
        problems: Sequence[Problem] = ()
        try:
            fetched = fetch(context, row, folder, progress)
            check_sha256(row.sha256, fetched.sha256, row.filename)
            make = partial(fetched.unpack_to, context=context, name=row.filename, progress=progress)
            with context.scratch.entry(f"drive-{fetched.sha256}", make) as root:
                drive = open_drive(root)
                problems = validate(drive, progress)
                good = without_bad_scans(drive, problems)
                info, scans, points = _describe(good, progress)
        except InputError as error:
            problems = [_renamed(problem, row.filename) for problem in problems or error.problems]
            digest, size = (fetched.sha256, fetched.size) if fetched is not None else (None, None)
            if digest is not None:
                context.scratch.drop(f"drive-{digest}")
            log.info("drive rejected", problems=[str(problem) for problem in problems[:10]])
            return Done(
                lambda tx, claim, cost: workflow.drive_checked(
                    tx, claim, cost, usable=False, problems=problems, sha256=digest, size=size
                ),
                afterwards=lambda: _delete(context, row.object_key),
            )
    log.info("drive ready", scans=scans, points=points, problems=len(problems))
    return Done(
        lambda tx, claim, cost: workflow.drive_checked(
            tx,
            claim,
            cost,
            usable=True,
            problems=problems,
            sha256=fetched.sha256,
            size=fetched.size,
            format=good.format,
            info=info,
        ),
        scans=scans,
        points=points,
    )


def _ingest_model(context: Context, row: ModelRow, progress: Progress) -> Done:
    with context.scratch.workdir() as folder:
        archive = folder / "model.zip"
        sha256 = download(context, row.object_key, archive, row.size, progress)
        try:
            check_sha256(row.sha256, sha256, row.filename)
            info = check_model(archive, context.settings.threads, progress)
        except InputError as error:
            problems = [_without_path(problem, folder, row.filename) for problem in error.problems]
            log.info("model rejected", problems=[str(problem) for problem in problems])
            return Done(
                lambda tx, claim, cost: workflow.model_checked(tx, claim, cost, problems=problems, sha256=sha256),
                afterwards=lambda: _delete(context, row.object_key),
            )
    return Done(lambda tx, claim, cost: workflow.model_checked(tx, claim, cost, problems=[], sha256=sha256, info=info))


def check_model(archive: Path, threads: int, progress: Progress = silent) -> Json:
    """What the catalog says about a zipped bundle. ModelError for one that cannot be used."""
    report = check_bundle(archive, threads=threads, progress=progress)
    return {
        "name": report.name,
        "label_space": report.label_space,
        "classes": list(report.classes),
        "input": report.graphs[0].input[2:],
        "has_boundary": report.boundary,
        "passes": sorted(graph.preset for graph in report.graphs[1:]),
    }


def _describe(drive: Drive, progress: Progress) -> tuple[Json, int, int]:
    """What the catalog says about a drive: its scenes with scans and points, and whether it has truth."""
    scans = [scan for scene in drive.scenes for scan in scene.scans]
    scenes: list[Json] = []
    total = done = 0
    for scene in drive.scenes:
        points = 0
        for scan in scene.scans:
            points += len(scan.load_points())
            done += 1
            progress("count", done, len(scans))
        scenes.append({"name": scene.name, "scans": len(scene.scans), "points": points})
        total += points
    info = {
        "scenes": scenes,
        "scans": len(scans),
        "points": total,
        "has_truth": drive.has_truth,
        "truth_space": drive.truth_space,
    }
    return info, len(scans), total


def _renamed(problem: Problem, filename: str) -> Problem:
    """The same problem under the name the user knows, where it concerns the folder that we unpacked to."""
    return replace(problem, where=filename) if problem.where == "log" else problem


def _without_path(problem: Problem, folder: Path, filename: str) -> Problem:
    """The same problem under the name the user knows instead of the scratch file's."""
    where = problem.where.replace(str(folder / "model.zip"), filename)
    return replace(problem, where=where)


def _delete(context: Context, key: str | None) -> None:
    if key is not None:
        with suppress(StoreError):  # the reconciler deletes what is left
            context.store.delete(key)
