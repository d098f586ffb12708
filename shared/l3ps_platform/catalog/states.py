"""The states of rows, spelled as scripts and clients see them."""

from __future__ import annotations

from enum import StrEnum


class UploadState(StrEnum):
    """An upload's life."""

    OPEN = "open"
    COMPLETE = "complete"
    ABORTED = "aborted"


class DriveState(StrEnum):
    """A drive's life; a rejected one has its problems, and its archive is gone."""

    UPLOADED = "uploaded"
    VALIDATING = "validating"
    READY = "ready"
    REJECTED = "rejected"


class ModelState(StrEnum):
    """A model bundle's life."""

    UPLOADED = "uploaded"
    VALIDATING = "validating"
    READY = "ready"
    REJECTED = "rejected"


class JobState(StrEnum):
    """A job's life, and a training's."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether the job will not change any more."""
        return self in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)


ACTIVE = tuple(state for state in JobState if not state.final)
"""States of jobs and trainings that are not over."""


class StageState(StrEnum):
    """A stage's life; scenes use the same words."""

    WAITING = "waiting"
    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether the stage will not change any more."""
        return self in (StageState.DONE, StageState.FAILED, StageState.CANCELLED)


class DeliveryState(StrEnum):
    """The life of a webhook's delivery; a failed one can be replayed."""

    PENDING = "pending"
    DELIVERED = "delivered"
    FAILED = "failed"


class OutputState(StrEnum):
    """A stage output's life; a doomed one is being deleted."""

    LIVE = "live"
    DOOMED = "doomed"


class StageName(StrEnum):
    """What a stage does."""

    INGEST = "ingest"
    SEGMENT = "segment"
    REFINE = "refine"
    PUBLISH = "publish"
    TRAIN = "train"


class QueueName(StrEnum):
    """The queues: one for networks, one for training them (where the trainer is installed), one for everything else."""

    SEGMENT = "segment"
    REFINE = "refine"
    TRAIN = "train"


QUEUE_OF = {
    StageName.INGEST: QueueName.REFINE,
    StageName.SEGMENT: QueueName.SEGMENT,
    StageName.REFINE: QueueName.REFINE,
    StageName.PUBLISH: QueueName.REFINE,
    StageName.TRAIN: QueueName.TRAIN,
}
"""Which queue a stage runs on."""
