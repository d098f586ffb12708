"""Limits in the catalog; the sweep enforces them."""

from __future__ import annotations

from sqlalchemy.orm import Session

from l3ps_api.retention.schemas import Retention, RetentionState
from l3ps_api.services import Services
from l3ps_platform.catalog import outputs, retention


def get(services: Services) -> RetentionState:
    """The limits; none where nobody set any."""
    with services.catalog.reading() as session:
        return _state(session)


def put(services: Services, request: Retention) -> RetentionState:
    """Set both limits."""
    with services.catalog.transaction() as tx:
        retention.put(tx, max_age_days=request.max_age_days, max_bytes=request.max_bytes)
        return _state(tx.session)


def _state(session: Session) -> RetentionState:
    row = retention.get(session)
    return RetentionState(
        max_age_days=row.max_age_days if row else None,
        max_bytes=row.max_bytes if row else None,
        stored_bytes=outputs.stored_bytes(session),
    )
