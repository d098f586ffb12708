"""Python client of the LiDAR label engine.

    with l3ps_client.Client() as client:
        drive = client.drives.upload("morning.tar")
        job = client.jobs.create(drive_id=drive["id"], model="colours")
        job = client.jobs.wait(job["id"])
        client.labels.download(job["id"], "labels")

Documents are the service's own, as typed dictionaries. Every failure is an ``L3psClientError``.
"""

from l3ps_client import webhooks
from l3ps_client._client import Client
from l3ps_client._documents import (
    FINAL,
    Annotations,
    Drive,
    ErrorItem,
    Job,
    JobState,
    JobSummary,
    LabelFile,
    LabelFiles,
    LabelFormat,
    Model,
    Page,
    Ref,
    Scene,
    Side,
    Stage,
    Training,
    TrainingSummary,
    Upload,
)
from l3ps_client._errors import (
    Conflict,
    Damaged,
    Forbidden,
    InvalidRequest,
    L3psClientError,
    NotFound,
    Refused,
    TimedOut,
    TooManyRequests,
    Unauthorized,
    Unreachable,
    sentences,
)
from l3ps_client._project_documents import Delivery, Key, Me, Project, Retention, Rule, Webhook
from l3ps_client._sending import Progress
from l3ps_client._sse import Event
from l3ps_client._wire import Retry

__all__ = [
    "FINAL",
    "Annotations",
    "Client",
    "Conflict",
    "Damaged",
    "Delivery",
    "Drive",
    "ErrorItem",
    "Event",
    "Forbidden",
    "InvalidRequest",
    "Job",
    "JobState",
    "JobSummary",
    "Key",
    "L3psClientError",
    "LabelFile",
    "LabelFiles",
    "LabelFormat",
    "Me",
    "Model",
    "NotFound",
    "Page",
    "Progress",
    "Project",
    "Ref",
    "Refused",
    "Retention",
    "Retry",
    "Rule",
    "Scene",
    "Side",
    "Stage",
    "TimedOut",
    "TooManyRequests",
    "Training",
    "TrainingSummary",
    "Unauthorized",
    "Unreachable",
    "Upload",
    "Webhook",
    "sentences",
    "webhooks",
]

for _name in __all__:
    if getattr(globals()[_name], "__module__", "").startswith("l3ps_client._"):
        globals()[_name].__module__ = "l3ps_client"
