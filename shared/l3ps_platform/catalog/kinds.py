"""The kinds of events, spelled as clients and webhooks see them."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from enum import StrEnum


class EventKind(StrEnum):
    """What can happen: a thing, and the state it has come to."""

    DRIVE_READY = "drive.ready"
    DRIVE_REJECTED = "drive.rejected"
    MODEL_READY = "model.ready"
    MODEL_REJECTED = "model.rejected"
    JOB_QUEUED = "job.queued"
    JOB_RUNNING = "job.running"
    JOB_SUCCEEDED = "job.succeeded"
    JOB_FAILED = "job.failed"
    JOB_CANCELLED = "job.cancelled"
    SCENE_DONE = "scene.done"
    SCENE_FAILED = "scene.failed"
    STAGE_RETRIED = "stage.retried"
    TRAINING_QUEUED = "training.queued"
    TRAINING_RUNNING = "training.running"
    TRAINING_SUCCEEDED = "training.succeeded"
    TRAINING_FAILED = "training.failed"
    TRAINING_CANCELLED = "training.cancelled"
    WEBHOOK_DISABLED = "webhook.disabled"


JOB_OVER = frozenset({EventKind.JOB_SUCCEEDED, EventKind.JOB_FAILED, EventKind.JOB_CANCELLED})
"""After one of these a job changes no more, unless somebody has it tried again."""

PING = "ping"
"""What a webhook's test carries; no event of the log."""


def select_kinds(patterns: Iterable[str]) -> frozenset[EventKind]:
    """The kinds that names and groups (``job.*``) mean; all of them where there are none. ValueError."""
    chosen: set[EventKind] = set()
    given = False
    for pattern in patterns:
        given = True
        found = [kind for kind in EventKind if pattern in (kind, f"{kind.partition('.')[0]}.*", "*")]
        if not found:
            raise ValueError(f"there is no kind of event {pattern!r}")
        chosen.update(found)
    return frozenset(chosen if given else EventKind)


def wanted(patterns: Collection[str], kind: str) -> bool:
    """Whether stored patterns mean this kind; a kind that a later release has done away with means nothing."""
    return not patterns or any(pattern in (kind, f"{kind.partition('.')[0]}.*", "*") for pattern in patterns)
