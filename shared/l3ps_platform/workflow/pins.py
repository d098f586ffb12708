"""Outputs in use: a stage says what it is about to look for, before it looks.

Outputs are shared: the same inputs and settings give the same key, for any job of the project. So one job's end says
nothing about whether its outputs may go. A stage *pins* an output first and then sees whether it is there; the sweep
looks for pins and then dooms. Both hold the output's row meanwhile, so of the two that meet, the second sees the first.
"""

from __future__ import annotations

from sqlalchemy import select

from l3ps_platform.catalog import outputs
from l3ps_platform.catalog.models import StageRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import OutputState
from l3ps_platform.errors import LeaseLost, OutputDoomed
from l3ps_platform.workflow.claims import Claim, owned


def pin_output(tx: Transaction, claim: Claim, key: str) -> None:
    """Keep an output for the claim's job or training; to be called before looking whether it is there.

    Args:
        tx: the transaction.
        claim: the stage.
        key: the prefix of the output's objects, without a slash at its end.

    Raises:
        LeaseLost: the stage is no longer ours.
        OutputDoomed: it is being deleted; in a moment it can be made anew.
    """
    stage = tx.session.scalars(select(StageRow).where(*owned(claim)).with_for_update()).one_or_none()
    if stage is None:
        raise LeaseLost(f"stage {claim.stage_id} attempt {claim.attempt} now belongs to another worker")
    row = outputs.hold(tx, key, claim.name, outputs.project_of_stage(tx.session, stage))
    if row.state is OutputState.DOOMED:
        raise OutputDoomed(f"{key} is being deleted from the object store just now")
    row.last_used_at = tx.now
    outputs.use(tx, key, stage.id)


def note_output(tx: Transaction, key: str, size: int) -> None:
    """Record how many bytes a complete output has."""
    row = outputs.lock(tx.session, key)
    if row is not None:
        row.bytes = size


def doom_output(tx: Transaction, key: str) -> bool:
    """Give an output up for deletion unless somebody needs it; whether it is so."""
    row = outputs.lock(tx.session, key)
    if row is None or row.state is OutputState.DOOMED or outputs.referred(tx.session, key):
        return False
    row.state = OutputState.DOOMED
    tx.session.flush()
    return True
