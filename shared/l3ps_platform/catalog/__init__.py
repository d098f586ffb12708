"""The catalog: what there is and what is being done with it.

Rows and states live here, queries only in the modules named after what they fetch: ``uploads``, ``drives``,
``bundles`` (models), ``annotation_sets``, ``jobs``, ``trainings``, ``stages``, ``figures`` (sums for the metrics),
``projects``, ``keys``, ``requests`` (POSTs that may be repeated), ``quotas``, ``events`` (the log, which a transaction
writes through ``outbox``), ``webhooks``. What changes states is in
:mod:`l3ps_platform.workflow`.
"""

from l3ps_platform.catalog import (
    annotation_sets,
    bundles,
    drives,
    events,
    figures,
    jobs,
    keys,
    projects,
    quotas,
    requests,
    stages,
    trainings,
    uploads,
    webhooks,
)
from l3ps_platform.catalog.access_rows import ApiKeyRow, RequestRow
from l3ps_platform.catalog.attempt_rows import AttemptRow, ModelFiguresRow, Outcome
from l3ps_platform.catalog.base import Base, Json, Owned
from l3ps_platform.catalog.event_rows import DeliveryRow, EventRow, WebhookRow
from l3ps_platform.catalog.kinds import EventKind
from l3ps_platform.catalog.models import (
    DEFAULT_PROJECT,
    AnnotationsRow,
    DriveRow,
    JobRow,
    ModelRow,
    ProjectRow,
    SceneRow,
    StageRow,
    StepRow,
    TrainingRow,
    UploadRow,
)
from l3ps_platform.catalog.session import Catalog, Sender, StageMessage, Transaction
from l3ps_platform.catalog.states import (
    QUEUE_OF,
    DeliveryState,
    DriveState,
    JobState,
    ModelState,
    QueueName,
    StageName,
    StageState,
    UploadState,
)

__all__ = [
    "DEFAULT_PROJECT",
    "QUEUE_OF",
    "AnnotationsRow",
    "ApiKeyRow",
    "AttemptRow",
    "Base",
    "Catalog",
    "DeliveryRow",
    "DeliveryState",
    "DriveRow",
    "DriveState",
    "EventKind",
    "EventRow",
    "JobRow",
    "JobState",
    "Json",
    "ModelFiguresRow",
    "ModelRow",
    "ModelState",
    "Outcome",
    "Owned",
    "ProjectRow",
    "QueueName",
    "RequestRow",
    "SceneRow",
    "Sender",
    "StageMessage",
    "StageName",
    "StageRow",
    "StageState",
    "StepRow",
    "TrainingRow",
    "Transaction",
    "UploadRow",
    "UploadState",
    "WebhookRow",
    "annotation_sets",
    "bundles",
    "drives",
    "events",
    "figures",
    "jobs",
    "keys",
    "projects",
    "quotas",
    "requests",
    "stages",
    "trainings",
    "uploads",
    "webhooks",
]
