"""The service's documents, as it sends them: plain dictionaries with typed fields.

A newer service may send more fields than these; they stay in the dictionary and disturb nobody. Times are ISO 8601
strings in UTC, sizes bytes, qualities per cent.
"""

from __future__ import annotations

from typing import Any, Generic, Literal, NotRequired, TypedDict, TypeVar

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
StageState = Literal["waiting", "queued", "running", "done", "failed", "cancelled"]
FileState = Literal["uploaded", "validating", "ready", "rejected"]
Side = Literal["primal", "refined"]
LabelFormat = Literal["nuscenes", "semantickitti"]

FINAL: tuple[JobState, ...] = ("succeeded", "failed", "cancelled")
"""States in which a job or training is over."""

Item = TypeVar("Item")


class Page(TypedDict, Generic[Item]):
    """Some items and where the next begin."""

    items: list[Item]
    next: NotRequired[str | None]


class ErrorItem(TypedDict):
    """One thing wrong with a request or with what it refers to."""

    where: str
    what: str
    remedy: str
    code: NotRequired[str | None]
    severity: NotRequired[str | None]
    scene: NotRequired[str | None]
    scan: NotRequired[str | None]


class _File(TypedDict):
    id: str
    name: str
    filename: str
    size: int
    sha256: str | None
    created_at: str


class Annotations(_File):
    """An archive of annotated images."""


class Drive(_File):
    """A drive log: its state, what the check found in it and, if it was rejected, why."""

    format: str | None
    state: FileState
    problems: list[ErrorItem]
    problem_count: NotRequired[int]
    info: dict[str, Any] | None


class Model(_File):
    """A model bundle."""

    state: FileState
    problems: list[ErrorItem]
    info: dict[str, Any] | None


class Ref(TypedDict):
    """Another resource, named in a document."""

    id: str
    name: str
    state: NotRequired[str]


class Step(TypedDict):
    """What a step of the method cost inside a stage."""

    name: str
    seconds: float
    peak_mb: float


class Stage(TypedDict):
    """One unit of work that a worker takes."""

    id: str
    name: str
    state: StageState
    attempt: int
    step: str | None
    done: int
    total: int
    fraction: float
    cached: bool
    seconds: float | None
    cpu_seconds: float | None
    peak_mb: float | None
    points: int | None
    message: str | None
    started_at: str | None
    finished_at: str | None
    steps: list[Step]


class Scene(TypedDict):
    """A scene of a job's drive."""

    id: str
    name: str
    position: int
    scans: int
    points: int
    state: StageState
    stages: list[Stage]


class _Work(TypedDict):
    id: str
    state: JobState
    cancel_requested: bool
    progress: float
    message: str | None
    errors: list[ErrorItem]
    created_at: str
    started_at: str | None
    finished_at: str | None


class JobSummary(_Work):
    """A job without its scenes, as lists have it."""

    drive: Ref
    model: Ref
    preset: str
    segment: str
    formats: list[str]
    protocol: str | None
    skip_bad_scans: bool
    quality: dict[str, Any] | None


class Job(JobSummary):
    """A job in full."""

    stages: list[Stage]
    scenes: list[Scene]


class TrainingSummary(_Work):
    """A training without its log and report, as lists have it."""

    name: str
    annotations: Ref
    validation: Ref | None
    settings: dict[str, Any]
    figures: dict[str, Any]
    model: Ref | None


class Training(TrainingSummary):
    """A training in full."""

    stage: Stage
    log: str
    log_url: str | None
    report: dict[str, Any] | None
    bundle_url: str | None


class PartUrl(TypedDict):
    """Where a part of an upload goes."""

    number: int
    url: str


class ReceivedPart(TypedDict):
    """A part that the service has."""

    number: int
    size: int
    etag: str


class Upload(TypedDict):
    """An upload in progress, or what became of it."""

    id: str
    kind: str
    filename: str
    size: int
    state: Literal["open", "complete", "aborted"]
    result_id: str | None
    created_at: str
    expires_at: str
    part_size: NotRequired[int]
    parts: NotRequired[list[PartUrl]]
    received: NotRequired[list[ReceivedPart]]
    joined: NotRequired[bool]


class LabelFile(TypedDict):
    """A file of labels with its checksum and where to GET it."""

    path: str
    size: int
    sha256: str
    url: str
    side: NotRequired[Side | None]
    scene: NotRequired[str | None]
    scan: NotRequired[str | None]


class LabelFiles(TypedDict):
    """A finished job's files in one format."""

    job_id: str
    format: str
    files: list[LabelFile]
    next: NotRequired[str | None]


class Me(TypedDict):
    """Who the service takes the caller for."""

    project: Ref
    scope: Literal["read", "write", "admin", "operator"]
    key: Ref | None


class Project(TypedDict):
    """A project: its drives, models and jobs are nobody else's."""

    id: str
    name: str
    created_at: str


class Key(TypedDict):
    """An API key; ``secret`` is there only in the answer that makes or rotates it.

    It is None in the answer to a request that was repeated because its answer was lost: rotate the key then.
    """

    id: str
    name: str
    scope: Literal["read", "write", "admin"]
    created_at: str
    expires_at: NotRequired[str | None]
    revoked_at: NotRequired[str | None]
    last_used_at: NotRequired[str | None]
    previous_until: NotRequired[str | None]
    secret: NotRequired[str | None]


class Webhook(TypedDict):
    """An address that the service tells of events; ``secret`` is there only in the answer that makes or rotates it."""

    id: str
    url: str
    events: list[str]
    description: str
    enabled: bool
    disabled_reason: str | None
    failing_since: str | None
    previous_secret_until: str | None
    created_at: str
    secret: NotRequired[str | None]


class Delivery(TypedDict):
    """One message on its way to a webhook, and how it fared; ``id`` is its ``webhook-id`` at every attempt."""

    id: str
    webhook_id: str
    type: str
    state: Literal["pending", "delivered", "failed"]
    attempts: int
    next_at: str | None
    last_status: int | None
    last_error: str | None
    created_at: str
    delivered_at: str | None
    body: str
    log: list[dict[str, Any]]


class Rule(TypedDict):
    """What turns a log that arrives in a bucket into a job."""

    id: str
    name: str
    bucket: str
    prefix: str
    suffix: NotRequired[str | None]
    model: str
    arrivals: int
    latest: NotRequired[dict[str, Any] | None]
    created_at: str


class Retention(TypedDict):
    """How long and how much a project's finished results are kept; None for no bound."""

    max_age_days: int | None
    max_bytes: int | None
    stored_bytes: NotRequired[int]
