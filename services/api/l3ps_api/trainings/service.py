"""Trainings."""

from __future__ import annotations

from contextlib import suppress

from sqlalchemy.orm import Session

from l3ps_api.jobs.service import check_active_jobs, stage_document
from l3ps_api.pages import cut
from l3ps_api.problems import ApiProblem, conflict, invalid
from l3ps_api.services import Services
from l3ps_api.trainings.schemas import (
    Training,
    TrainingPage,
    TrainingRequest,
    TrainingSettings,
    TrainingSummary,
    summary_fields,
)
from l3ps_platform.catalog import JobState, UploadState, annotation_sets, bundles, stages, trainings, uploads
from l3ps_platform.catalog.requests import note_result
from l3ps_platform.errors import Conflict, NotFound, ObjectMissing
from l3ps_platform.ids import is_id
from l3ps_platform.workflow import cancel_training, retry_training, submit_training

_LOG_TAIL = 4000
"""Bytes of the log that a document carries: some forty lines."""
_UNAVAILABLE = (
    "No worker of this service trains models: the trainer, which needs torch, is not installed with it. Whoever runs "
    "the service installs l3ps-trainer beside a worker, starts that worker on the queue `train` and sets "
    "L3PS_TRAINING=1. With `l3ps up`: make setup-trainer, then start it again; with compose: L3PS_TRAINING=1 docker "
    "compose --profile train up."
)


def create(services: Services, request: TrainingRequest) -> Training:
    """A new training, or the same one that was asked for before. NotFound, Conflict; 503 where nobody trains."""
    if not services.settings.training:
        raise ApiProblem(503, "training-unavailable", "This service does not train", _UNAVAILABLE)
    fields = set(TrainingSettings.model_fields)
    settings = request.model_dump(mode="json", include=fields, exclude_none=True)
    measured = request.validation
    if isinstance(measured, float):
        settings["validation"] = measured
    try:
        with services.catalog.transaction() as tx:
            check_active_jobs(services, tx.session)
            annotations_id = _annotations(tx.session, "annotations", request.annotations)
            validation_id = _annotations(tx.session, "validation", measured) if isinstance(measured, str) else None
            row = submit_training(
                tx, name=request.name, annotations_id=annotations_id, validation_id=validation_id, settings=settings
            )
    except Conflict as error:
        detail = f"{str(error)[:1].upper()}{str(error)[1:]}. Nothing was started."
        raise conflict(
            "name-taken", "The name is taken", detail, where="name", remedy="Choose another name."
        ) from error
    return get(services, row.id)


def page(services: Services, limit: int, cursor: str | None, state: JobState | None) -> TrainingPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = trainings.page(session, limit=limit + 1, before=cursor, state=state)
        shown, following = cut(rows, limit)
        sets = annotation_sets.many(session, [id for row in shown for id in (row.annotations_id, row.validation_id)])
        models = bundles.many(session, [row.model_id or "" for row in shown])
        work = stages.of_trainings(session, [row.id for row in shown])
    items = [TrainingSummary(**summary_fields(row, sets, models, work[row.id].fraction)) for row in shown]
    for item in items:
        item.settings = {name: value for name, value in item.settings.items() if name != "classes"}
    return TrainingPage(items=items, next=following)


def get(services: Services, training_id: str) -> Training:
    """One training in full. NotFound."""
    with services.catalog.reading() as session:
        row = trainings.get(session, training_id)
        sets = annotation_sets.many(session, [row.annotations_id, row.validation_id])
        models = bundles.many(session, [row.model_id or ""])
        stage = stages.of_training(session, row.id)
        steps = stages.steps(session, [stage.id])[stage.id]
    bundle = models[row.model_id].object_key if row.model_id is not None else None
    return Training(
        **summary_fields(row, sets, models, stage.fraction),
        stage=stage_document(stage, steps),
        log=_tail(services, row.log_key),
        log_url=_url(services, row.log_key, f"{row.name}.log"),
        report=row.report,
        bundle_url=_url(services, bundle, f"{row.name}.zip"),
    )


def cancel(services: Services, training_id: str) -> Training:
    """Ask a training to stop; one that is cancelled stays so. NotFound, Conflict when it came to another end."""
    with services.catalog.transaction() as tx:
        state = cancel_training(tx, training_id).state
        if state in (JobState.SUCCEEDED, JobState.FAILED):
            raise Conflict(f"training {training_id} has {state} already: there is nothing left to cancel")
        note_result(tx.session, "trainings", training_id)
    return get(services, training_id)


def retry(services: Services, training_id: str) -> Training:
    """Run a failed or cancelled training again. NotFound, Conflict for another; 429 where too many are under way."""
    with services.catalog.transaction() as tx:
        check_active_jobs(services, tx.session)
        retry_training(tx, training_id)
        note_result(tx.session, "trainings", training_id)
    return get(services, training_id)


def _annotations(session: Session, field: str, id: str) -> str:
    """The id of annotations, from it or from their upload's."""
    remedy = "Upload an archive of annotated images with kind annotations and name it, or its upload."
    for prefix, kind in (("drv", "drive"), ("mdl", "model")):
        if is_id(id, prefix):  # type: ignore[arg-type]
            raise invalid(field, f"{id} is a {kind}", remedy, code="not-annotations")
    if not is_id(id, "upl"):
        return id
    try:
        upload = uploads.get(session, id)
    except NotFound:
        raise NotFound("annotations", id) from None
    if upload.kind != "annotations":
        raise invalid(field, f"the upload {id} is of kind {upload.kind}", remedy, code="not-annotations")
    if upload.state is not UploadState.COMPLETE or upload.result_id is None:
        detail, remedy = f"Upload {id} is {upload.state}.", "Complete it before the training is started."
        raise conflict("upload-open", "The upload is not complete", f"{detail} {remedy}", where=field, remedy=remedy)
    return upload.result_id


def _tail(services: Services, key: str | None) -> str:
    if key is None:
        return ""
    with suppress(ObjectMissing):
        size = services.store.stat(key).size
        text = services.store.get_bytes(key, max(0, size - _LOG_TAIL)).decode(errors="replace")
        return text if size <= _LOG_TAIL else text.partition("\n")[2]
    return ""


def _url(services: Services, key: str | None, filename: str) -> str | None:
    return services.store.presign_get(key, services.settings.url_ttl_seconds, filename) if key is not None else None
