"""The catalog: what there is and what is being done with it.

Rows and states live here, queries only in the modules named after what they fetch: ``uploads``, ``drives``,
``bundles`` (models), ``annotation_sets``, ``jobs``, ``trainings``, ``stages``, ``outputs``, ``retention``,
``belongings`` (whose an object is), ``figures`` (sums for the metrics). What changes states is in
:mod:`l3ps_platform.workflow`.
"""

from l3ps_platform.catalog import (
    annotation_sets,
    belongings,
    bundles,
    drives,
    figures,
    jobs,
    outputs,
    retention,
    stages,
    trainings,
    uploads,
)
from l3ps_platform.catalog.base import Base, Json, Owned
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
from l3ps_platform.catalog.output_rows import OutputRow, OutputUseRow, RetentionRow
from l3ps_platform.catalog.session import Catalog, Sender, StageMessage, Transaction
from l3ps_platform.catalog.states import (
    QUEUE_OF,
    DriveState,
    JobState,
    ModelState,
    OutputState,
    QueueName,
    StageName,
    StageState,
    UploadState,
)

__all__ = [
    "DEFAULT_PROJECT",
    "QUEUE_OF",
    "AnnotationsRow",
    "Base",
    "Catalog",
    "DriveRow",
    "DriveState",
    "JobRow",
    "JobState",
    "Json",
    "ModelRow",
    "ModelState",
    "OutputRow",
    "OutputState",
    "OutputUseRow",
    "Owned",
    "ProjectRow",
    "QueueName",
    "RetentionRow",
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
    "annotation_sets",
    "belongings",
    "bundles",
    "drives",
    "figures",
    "jobs",
    "outputs",
    "retention",
    "stages",
    "trainings",
    "uploads",
]
