"""Jobs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import structlog
from sqlalchemy.orm import Session

from l3ps.errors import InputError
from l3ps_api.jobs.schemas import Job, JobPage, JobRequest, JobSummary, Scene, Stage, Step, summary_fields
from l3ps_api.limits import over_quota
from l3ps_api.pages import cut
from l3ps_api.problems import ApiProblem, invalid, items
from l3ps_api.services import Services
from l3ps_api.sources import permitted
from l3ps_platform.catalog import JobRow, JobState, StageRow, StepRow, bundles, drives, jobs, quotas, stages
from l3ps_platform.catalog.requests import note_result
from l3ps_platform.errors import Conflict
from l3ps_platform.workflow import MAX_PROBLEMS, accept_source, cancel_job, outputs_to_keep, retry_job, submit_job

log = structlog.get_logger(__name__)

_STEPS = (
    *("segment", "accumulate", "ground", "cluster", "vote", "instances", "write", "evaluate", "store"),
    *("features", "train", "export", "validate"),
)
"""The order in which a stage takes its steps, for showing them; the catalog keeps them by name."""
_LOOKS = 16
"""Objects looked for at a time. Of a job whose every scene failed there may be 850."""


def create(services: Services, project_id: str, request: JobRequest) -> Job:
    """A new job. NotFound for its drive or model; 422 with the problems of a rejected one; 403 for a foreign source."""
    if (request.drive_id is None) == (request.source is None):
        what = "a job is on one drive or on one source, and neither or both are named"
        raise invalid("drive_id", what, "Name either drive_id or source.")
    source = None if request.source is None else permitted(services, project_id, request.source)
    settings = request.model_dump(exclude={"drive_id", "source"})
    try:
        with services.catalog.transaction() as tx:
            check_active_jobs(services, tx.session)
            drive_id = request.drive_id or accept_source(tx, source=str(source)).id
            job = submit_job(tx, drive_id=drive_id, **settings)
    except InputError as error:
        found = error.problems
        count = "one problem" if len(found) == 1 else f"{len(found)} problems"
        count = f"at least {count}" if len(found) == MAX_PROBLEMS else count
        skippable = all(problem.severity == "scan" for problem in found)
        remedy = (
            "Send skip_bad_scans to label the good scans." if skippable else "Correct the input and upload it again."
        )
        detail = f"The log or model cannot be used as it is; it has {count}, the first: {found[0]} {remedy}"
        raise ApiProblem(422, "unusable-input", "The job's input cannot be used", detail, items(found)) from error
    log.info("job accepted", job=job.id, drive=job.drive_id, model=job.model_id)
    return get(services, job.id)


def check_active_jobs(services: Services, session: Session) -> None:
    """429 where the project has as many jobs and trainings under way as it may; a few more when asked in parallel."""
    limit = services.settings.max_active_jobs
    if quotas.active_jobs(session) >= limit:
        raise over_quota("jobs", limit, "jobs and trainings under way", "Wait for some to end, or cancel them.")


def page(services: Services, limit: int, cursor: str | None, wanted: jobs.Wanted) -> JobPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = jobs.page(session, wanted, limit=limit + 1, before=cursor)
        shown, following = cut(rows, limit)
        of_drive = drives.many(session, [row.drive_id for row in shown])
        of_model = bundles.many(session, [row.model_id for row in shown])
        progress = stages.progress(session, [row.id for row in shown])
    summaries = [
        JobSummary(
            **summary_fields(
                row, of_drive[row.drive_id], of_model[row.model_id], _share(row, *progress.get(row.id, (0.0, 0)))
            )
        )
        for row in shown
    ]
    return JobPage(items=summaries, next=following)


def get(services: Services, job_id: str) -> Job:
    """One job in full. NotFound."""
    with services.catalog.reading() as session:
        return _document(session, job_id)


def encoded(services: Services, job_id: str) -> bytes:
    """The same as JSON, made anew only when something has changed. NotFound."""
    with services.catalog.reading() as session:
        revision = jobs.revision(session, job_id)
        return services.documents.get(job_id, revision, lambda: _document(session, job_id).model_dump_json().encode())


def cancel(services: Services, job_id: str) -> Job:
    """Ask a job to stop; one that is cancelled stays so. NotFound, Conflict when it came to another end."""
    with services.catalog.transaction() as tx:
        state = cancel_job(tx, job_id).state
        if state in (JobState.SUCCEEDED, JobState.FAILED):
            raise Conflict(f"job {job_id} has {state} already: there is nothing left to cancel")
        note_result(tx.session, "jobs", job_id)
    return get(services, job_id)


def retry(services: Services, job_id: str) -> Job:
    """Run a failed or cancelled job again. NotFound, Conflict for another; 422 when its drive or model was rejected;
    429 where as many are under way as may be."""
    with services.catalog.reading() as session:
        check_active_jobs(services, session)
        wanted = outputs_to_keep(session, job_id)
    with ThreadPoolExecutor(_LOOKS) as pool:
        gone = [key for key, there in zip(wanted, pool.map(services.store.exists, wanted), strict=True) if not there]
    with services.catalog.transaction() as tx:
        check_active_jobs(services, tx.session)
        retry_job(tx, job_id, gone)
        note_result(tx.session, "jobs", job_id)
    return get(services, job_id)


def delete(services: Services, job_id: str) -> None:
    """Hide a finished job at once; the reconciler deletes its labels. NotFound, Conflict while it is not over."""
    with services.catalog.transaction() as tx:
        jobs.delete(tx, job_id)


def _document(session: Session, job_id: str) -> Job:
    job, drive, model = jobs.with_inputs(session, job_id)
    rows = stages.of_job_and_drive(session, job.id, job.drive_id)
    planned = [row for row in rows if row.job_id == job.id]
    steps = stages.steps(session, [row.id for row in rows])
    done = sum(1.0 if row.state.final else row.fraction for row in planned)

    def shown(chosen: Iterable[StageRow]) -> list[Stage]:
        return [stage_document(row, steps[row.id]) for row in chosen]

    of_scene: dict[str | None, list[StageRow]] = defaultdict(list)
    for row in planned:
        of_scene[row.scene_id].append(row)
    scenes = [
        Scene(
            id=scene.id,
            name=scene.name,
            position=scene.position,
            scans=scene.scans,
            points=scene.points,
            state=scene.state,
            stages=shown(of_scene[scene.id]),
        )
        for scene in jobs.scenes(session, job.id)
    ]
    own = shown(row for row in rows if row.scene_id is None)
    return Job(**summary_fields(job, drive, model, _share(job, done, len(planned))), stages=own, scenes=scenes)


def stage_document(row: StageRow, steps: list[StepRow]) -> Stage:
    """A stage as clients see it."""
    ordered = sorted(steps, key=lambda step: _STEPS.index(step.name) if step.name in _STEPS else len(_STEPS))
    return Stage(
        id=row.id,
        name=row.name,
        state=row.state,
        attempt=row.attempt,
        step=row.progress_step,
        done=row.progress_done,
        total=row.progress_total,
        fraction=1.0 if row.state.final else row.fraction,
        cached=row.cached,
        seconds=row.seconds,
        cpu_seconds=row.cpu_seconds,
        peak_mb=row.peak_mb,
        points=row.points,
        message=(row.error or {}).get("message"),
        started_at=row.started_at,
        finished_at=row.finished_at,
        steps=[Step(name=step.name, seconds=step.seconds, peak_mb=step.peak_mb) for step in ordered],
    )


def _share(job: JobRow, done: float, total: int) -> float:
    if job.state is JobState.SUCCEEDED:
        return 1.0
    return min(1.0, done / total) if total else 0.0
