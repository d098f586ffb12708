"""Drives: the logs that were uploaded."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from l3ps_api.drives import service
from l3ps_api.drives.schemas import Drive, DrivePage
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of

router = APIRouter(prefix="/v1/drives", tags=["drives"])


@router.get("")
def list_drives(
    services: ServicesDep,
    limit: Limit = 50,
    cursor: Annotated[Cursor, id_of("drv")] = None,
    sha256: Annotated[str | None, Query(description="Only archives of these bytes.", max_length=64)] = None,
) -> DrivePage:
    """Drives, newest first."""
    return service.page(services, limit, cursor, sha256)


@router.get("/{drive_id}")
def get_drive(drive_id: str, services: ServicesDep) -> Drive:
    """A drive: its state, what the check found in it and, if it was rejected, why."""
    return service.get(services, drive_id)


@router.delete("/{drive_id}", status_code=204)
def delete_drive(drive_id: str, services: ServicesDep) -> None:
    """Delete a drive's archive. Refused while a job uses it; finished jobs keep their labels."""
    service.delete(services, drive_id)
