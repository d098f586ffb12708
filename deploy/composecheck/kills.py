"""kill -9 of every container in turn, each while a job is under way: it comes back, and the job succeeds."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from composecheck import looks
from composecheck.command import CheckError
from composecheck.stack import Stack

VICTIMS = ("worker-segment", "worker-refine", "api", "redis", "postgres", "minio", "prometheus")
BACK_SECONDS, JOB_SECONDS = 120, 300

_AT_WORK = {"worker-segment": "segment", "worker-refine": "refine"}
"""Workers die while they hold a stage of this name; the others while any stage runs."""


def kill(stack: Stack, victim: str, drive: Path, model: str) -> str:
    """Submit a job, kill a container in the middle of it, and see both recover.

    Args:
        stack: the running stack.
        victim: a service of the compose file.
        drive: a drive that the stack has not labelled yet, so that there is work to do.
        model: name of a model that the stack has, or a bundle.
    """
    job = json.loads(stack.cli("submit", drive, "--model", model, "--json"))["id"]
    stage = _AT_WORK.get(victim)
    until(lambda: at_work(stack, job, stage), JOB_SECONDS, f"Job {job} never had a {stage or 'stage'} at work.")
    before = _container(stack, victim)
    began = time.monotonic()
    try:
        os.kill(before["State"]["Pid"], signal.SIGKILL)
    except PermissionError as error:
        # `docker kill` would not do: the engine takes it for a stop that was meant, and starts nothing again.
        raise CheckError("killing a container's process takes the rights of root: run this check with them") from error
    until(lambda: _is_back(stack, victim, before), BACK_SECONDS, f"{victim} did not come back.")
    back = time.monotonic() - began
    until(lambda: over(stack, job), JOB_SECONDS, f"Job {job} did not end after the death of {victim}.")
    ended = stack.get(f"/v1/jobs/{job}")
    if ended["state"] != "succeeded":
        raise CheckError(f"Job {job} ended {ended['state']} after the death of {victim}: {ended['message']}")
    looks.labels(stack, job, drive)
    attempts = max(stage["attempt"] for scene in ended["scenes"] for stage in scene["stages"])
    whole = time.monotonic() - began
    return f"back after {back:.0f} s, job succeeded {whole:.0f} s after the kill with {attempts} attempts at most"


def at_work(stack: Stack, job: str, name: str | None) -> bool:
    """Whether a stage of this name, or any, runs; CheckError when the job is over."""
    document = stack.get(f"/v1/jobs/{job}")
    if document["state"] in ("succeeded", "failed", "cancelled"):
        raise CheckError(f"Job {job} was {document['state']} before anything was killed.")
    found = [stage for scene in document["scenes"] for stage in scene["stages"] if stage["state"] == "running"]
    return any(name in (None, running["name"]) for running in found)


def _container(stack: Stack, service: str) -> dict[str, Any]:
    found = stack.compose("ps", "--all", "--quiet", service).split()
    if len(found) != 1:
        raise CheckError(f"{len(found)} containers of {service} are there, one was expected.")
    return dict(json.loads(stack.docker.run("inspect", found[0]))[0])


def _is_back(stack: Stack, service: str, before: dict[str, Any]) -> bool:
    state = _container(stack, service)["State"]
    fresh = state["Running"] and state["StartedAt"] != before["State"]["StartedAt"]
    return bool(fresh and state.get("Health", {}).get("Status", "healthy") == "healthy")


def over(stack: Stack, job: str) -> bool:
    """Whether the job has ended, well or not."""
    return stack.get(f"/v1/jobs/{job}")["state"] in ("succeeded", "failed", "cancelled")


def until(ready: Callable[[], bool], seconds: float, otherwise: str) -> None:
    """Wait for something to be true; an API that does not answer is no answer. CheckError after ``seconds``."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with suppress(OSError):
            if ready():
                return
        time.sleep(0.3)
    raise CheckError(f"{otherwise} ({seconds:.0f} s)")
