"""The worker's real application, where the ends of the first stage can be recorded in no way."""

from typing import Any

from l3ps_platform import workflow
from l3ps_worker.app import app

__all__ = ["app"]


def broken(real: Any) -> Any:
    """The function, for claims of a second attempt on."""

    def record(tx: workflow.Transaction, claim: workflow.Claim, *given: Any, **named: Any) -> None:
        if claim.attempt == 1:
            raise ValueError("this cannot be recorded")
        real(tx, claim, *given, **named)

    return record


workflow.model_checked = broken(workflow.model_checked)
workflow.fail = broken(workflow.fail)
