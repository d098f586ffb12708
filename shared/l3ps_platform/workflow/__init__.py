"""The state machine of drives, models, jobs, scenes, trainings and stages.

Functions take a transaction and change rows.

accept_drive, accept_model     an upload is complete → ingest
submit_job, cancel_job,        what clients ask for
  submit_training, cancel_training
claim, prolong, report       a worker takes a stage and says it is alive
complete, drive_checked,       how it ended, and what follows from that
  model_checked, training_done,
  fail, cancelled
pin_output, note_output      what a stage computes belongs to whoever needs it
Reconciler, lease_lost         what nobody is left to report
"""

from l3ps_platform.catalog.session import Transaction
from l3ps_platform.workflow.claims import Claim, check_cancelled, claim, prolong, report
from l3ps_platform.workflow.outcomes import (
    Cost,
    Retry,
    cancel_job,
    cancelled,
    complete,
    drive_checked,
    fail,
    model_checked,
    release,
    release_owned,
)
from l3ps_platform.workflow.pins import doom_output, note_output, pin_output
from l3ps_platform.workflow.planning import accept_drive, accept_model, error_json, problems_of, submit_job
from l3ps_platform.workflow.reconcile import Reconciler, Report, lease_lost
from l3ps_platform.workflow.sweep import Sweeper
from l3ps_platform.workflow.trainings import cancel_training, note_training, submit_training, training_done

__all__ = [
    "Claim",
    "Cost",
    "Reconciler",
    "Report",
    "Retry",
    "Sweeper",
    "Transaction",
    "accept_drive",
    "accept_model",
    "cancel_job",
    "cancel_training",
    "cancelled",
    "check_cancelled",
    "claim",
    "complete",
    "doom_output",
    "drive_checked",
    "error_json",
    "fail",
    "lease_lost",
    "model_checked",
    "note_output",
    "note_training",
    "pin_output",
    "problems_of",
    "prolong",
    "release",
    "release_owned",
    "report",
    "submit_job",
    "submit_training",
    "training_done",
]
