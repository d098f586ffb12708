"""Trainings: models made from annotated images."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from l3ps_api.services import Cursor, Limit, ServicesDep, id_of
from l3ps_api.trainings import service
from l3ps_api.trainings.schemas import Training, TrainingPage, TrainingRequest
from l3ps_platform.catalog import JobState

router = APIRouter(prefix="/v1", tags=["training"])


@router.post("/models/train", status_code=202)
def train_model(request: TrainingRequest, response: Response, services: ServicesDep) -> Training:
    """Train a model from uploaded annotations. The same request again answers with the same training."""
    training = service.create(services, request)
    response.headers["Location"] = f"/v1/trainings/{training.id}"
    return training


@router.get("/trainings")
def list_trainings(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("trn")] = None,
    state: Annotated[JobState | None, Query(description="Only trainings in this state.")] = None,
) -> TrainingPage:
    """Trainings, newest first."""
    return service.page(services, limit, cursor, state)


@router.get("/trainings/{training_id}")
def get_training(training_id: str, services: ServicesDep) -> Training:
    """A training with its progress, its first figures and the end of its log; once done its report and its model."""
    return service.get(services, training_id)


@router.post("/trainings/{training_id}/cancel", status_code=202)
def cancel_training(training_id: str, services: ServicesDep) -> Training:
    """Ask a training to stop, which it does within seconds. Refused when it has succeeded or failed."""
    return service.cancel(services, training_id)


@router.post("/trainings/{training_id}/retry", status_code=202)
def retry_training(training_id: str, services: ServicesDep) -> Training:
    """Run a failed or cancelled training again, from its last checkpoint. Refused in every other state."""
    return service.retry(services, training_id)
