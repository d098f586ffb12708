"""How much a project may have on its way at once: what is announced may fill a disk that is everybody's."""

from __future__ import annotations

from sqlalchemy.orm import Session

from l3ps_api.limits import over_quota
from l3ps_api.problems import fault
from l3ps_platform.catalog import quotas
from l3ps_platform.settings import Settings

_REMEDY = "Complete some of them, or give them up."


def check(session: Session, settings: Settings, size: int) -> None:
    """Refuse an upload of ``size`` bytes beyond what the project of a scoped catalog may have open."""
    count, held = quotas.open_uploads(session)
    if count >= settings.max_open_uploads:
        raise over_quota("uploads", settings.max_open_uploads, "open uploads", _REMEDY)
    limit = settings.max_open_upload_bytes
    if held + size > limit:
        what = f"{held} bytes are in the project's open uploads; {size} more would pass the {limit} it may have there"
        headers = {"Retry-After": "30"}
        raise fault(429, "quota-reached", "Quota reached", "size", what, _REMEDY, headers)
