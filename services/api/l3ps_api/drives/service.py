"""Drives."""

from __future__ import annotations

from l3ps_api.drives.schemas import Drive, DrivePage
from l3ps_api.pages import cut
from l3ps_api.services import Services
from l3ps_platform.catalog import drives


def page(services: Services, limit: int, cursor: str | None, sha256: str | None) -> DrivePage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = drives.page(session, limit=limit + 1, before=cursor, sha256=sha256)
    shown, following = cut(rows, limit)
    return DrivePage(items=[Drive.of(row) for row in shown], next=following)


def get(services: Services, drive_id: str) -> Drive:
    """One drive. NotFound."""
    with services.catalog.reading() as session:
        return Drive.of(drives.get(session, drive_id))


def delete(services: Services, drive_id: str) -> None:
    """Hide a drive at once; the reconciler deletes its archive. NotFound, Conflict while in use."""
    with services.catalog.transaction() as tx:
        drives.delete(tx, drive_id)
