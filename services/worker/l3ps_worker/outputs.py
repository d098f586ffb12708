"""A stage's output, pinned in the catalog before anybody looks whether it is in the store."""

from __future__ import annotations

import time

from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.errors import OutputDoomed
from l3ps_worker.context import Context

_PATIENCE = 30.0
"""Seconds to wait for an output that is being deleted: the sweep takes one round of the reconciler for it."""
_PAUSE = 0.5


def pin(context: Context, claim: workflow.Claim, prefix: str, progress: Progress) -> None:
    """Keep an output for the claim's job, whoever else gives it up from now on.

    Args:
        context, claim, progress: as a stage gets them.
        prefix: of the output's objects.

    Raises:
        OutputDoomed: it is still being deleted; a later attempt makes it anew.
        LeaseLost: the stage is no longer ours.
    """
    patience = time.monotonic() + _PATIENCE
    while True:
        try:
            with context.catalog.transaction() as tx:
                workflow.pin_output(tx, claim, prefix)
            return
        except OutputDoomed:
            if time.monotonic() > patience:
                raise
            progress("wait", 0, 1)
            time.sleep(_PAUSE)
