"""Where buckets tell of new objects."""

from __future__ import annotations

from fastapi import APIRouter

from l3ps_api.auth import PrincipalDep
from l3ps_api.notifications import service
from l3ps_api.notifications.schemas import Noted, Notification
from l3ps_api.services import ServicesDep

router = APIRouter(prefix="/v1/notifications", tags=["arrival"])


@router.post("/s3", status_code=202)
def notify(notification: Notification, services: ServicesDep, principal: PrincipalDep) -> Noted:
    """Take an S3 event notification. Each new object that meets a rule becomes one job, however often it is told of.

    MinIO's webhook target sends such events as they are; from AWS, have a small function POST them.
    """
    return service.take(services, principal.project_id, notification)
