"""Back-up in the middle of a job, loss of everything, restore: old labels are back, and the job goes on to its end."""

from __future__ import annotations

import json
from pathlib import Path

from composecheck import kills, looks
from composecheck.command import ROOT, CheckError, run
from composecheck.stack import Stack

COPY_SECONDS = 300


def lose_all_and_restore(stack: Stack, old_job: str, old_drive: Path, drive: Path, model: str) -> str:
    """Take a back-up in the middle of a job, delete every volume, restore, and see both jobs' labels.

    Args:
        stack: the running stack.
        old_job: a job that has succeeded.
        old_drive: its drive.
        drive: another drive that the stack has not labelled yet.
        model: name of a model that the stack has, or a bundle.
    """
    job = json.loads(stack.cli("submit", drive, "--model", model, "--json"))["id"]
    kills.until(lambda: kills.at_work(stack, job, None), kills.JOB_SECONDS, f"Job {job} never had a stage at work.")
    _copy(stack, "backup.sh")
    state = stack.get(f"/v1/jobs/{job}")["state"]
    stack.down("--volumes", "--timeout", "20")
    _copy(stack, "restore.sh")
    looks.labels(stack, old_job, old_drive)
    kills.until(lambda: kills.over(stack, job), kills.JOB_SECONDS, f"Job {job} did not end after the restoration.")
    ended = stack.get(f"/v1/jobs/{job}")
    if ended["state"] != "succeeded":
        raise CheckError(f"Job {job} ended {ended['state']} after the restoration: {ended['message']}")
    return f"a job that was {state} at the back-up: {looks.labels(stack, job, drive)}"


def _copy(stack: Stack, script: str) -> None:
    env = {**stack.docker.env, "COMPOSE_PROJECT_NAME": stack.project, "COMPOSE_ENV_FILES": str(stack.work / "env")}
    run(["sh", ROOT / "deploy" / script, stack.work / "copy"], stack.docker.log, COPY_SECONDS, env)
