"""The state machine of drives, models, jobs, scenes, trainings and stages.

Functions take a transaction and change rows; release_owned and settle_arrivals take a catalog, and make one for each
row.

accept_drive, accept_model     an upload is complete → ingest
accept_source, settle_arrivals a log lies, or has arrived, in somebody else's bucket → ingest, job
submit_job, cancel_job,        what clients ask for
  retry_job, and the same of trainings
claim, prolong, report       a worker takes a stage and says it is alive
complete, drive_checked,       how it ended, and what follows from that
  model_checked, training_done,
  fail, cancelled
pin_output, note_output      what a stage computes belongs to whoever needs it
Reconciler, lease_lost         what nobody is left to report
Cause, cause_of                why an attempt failed, in one word
"""

from l3ps_platform.catalog.session import Transaction
from l3ps_platform.workflow.again import outputs_to_keep, retry_job, retry_training
from l3ps_platform.workflow.arrivals import settle_arrivals
from l3ps_platform.workflow.attempts import Cost
from l3ps_platform.workflow.causes import Cause, cause_of, disk_is_full, failure
from l3ps_platform.workflow.claims import Claim, check_cancelled, claim, prolong, report
from l3ps_platform.workflow.outcomes import (
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
from l3ps_platform.workflow.planning import (
    accept_drive,
    accept_model,
    accept_source,
    error_json,
    submit_job,
)
from l3ps_platform.workflow.problems import MAX_PROBLEMS, problem_count, problems_of
from l3ps_platform.workflow.reconcile import Reconciler, Report, lease_lost
from l3ps_platform.workflow.retries import Retry
from l3ps_platform.workflow.sweep import Sweeper
from l3ps_platform.workflow.trainings import cancel_training, note_training, submit_training, training_done

__all__ = [
    "MAX_PROBLEMS",
    "Cause",
    "Claim",
    "Cost",
    "Reconciler",
    "Report",
    "Retry",
    "Sweeper",
    "Transaction",
    "accept_drive",
    "accept_model",
    "accept_source",
    "cancel_job",
    "cancel_training",
    "cancelled",
    "cause_of",
    "check_cancelled",
    "claim",
    "complete",
    "disk_is_full",
    "doom_output",
    "drive_checked",
    "error_json",
    "fail",
    "failure",
    "lease_lost",
    "model_checked",
    "note_output",
    "note_training",
    "outputs_to_keep",
    "pin_output",
    "problem_count",
    "problems_of",
    "prolong",
    "release",
    "release_owned",
    "report",
    "retry_job",
    "retry_training",
    "settle_arrivals",
    "submit_job",
    "submit_training",
    "training_done",
]
