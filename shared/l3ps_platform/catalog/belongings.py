"""Whose an object is."""

from __future__ import annotations

from collections.abc import Collection

from sqlalchemy import select
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import (
    AnnotationsRow,
    DriveRow,
    JobRow,
    ModelRow,
    ProjectRow,
    TrainingRow,
    UploadRow,
)
from l3ps_platform.catalog.output_rows import OutputRow
from l3ps_platform.catalog.states import StageName, UploadState

TOPS = ("jobs/", "stages/", "trainings/", "uploads/")
"""Where the product keeps objects that rows refer to."""
HOLD_ARCHIVES = ("trainings/", "uploads/")
"""Those of them where an object may be one's archive: a training's bundle under another name lies beside its log."""
_ARCHIVES = (DriveRow, ModelRow, AnnotationsRow)


def group_of(key: str) -> str:
    """The prefix that an object shares with all others of its owner, without a slash at its end."""
    parts = key.split("/")
    return "/".join(parts[: 3 if parts[0] == "stages" and parts[1].startswith("prj_") else 2])


def owned(session: Session, group: str, keys: Collection[str]) -> bool:
    """Whether a row refers to objects of a group.

    Args:
        session: the session.
        group: their common prefix.
        keys: of the objects, where one may be an archive.
    """
    top, id = group.split("/")[:2]
    if top == "stages":
        return session.get(OutputRow, group) is not None
    if top == "jobs":
        job = session.get(JobRow, id)
        return job is not None and job.swept_at is None
    if top == "trainings":
        training = session.get(TrainingRow, id)
        if training is not None and (training.log_key is not None or not training.state.final):
            return True
    else:
        upload = session.get(UploadRow, id)
        if upload is not None and upload.state is UploadState.OPEN:
            return True
    queries = (select(kind.id).where(kind.object_key.in_(keys)) for kind in _ARCHIVES)
    return any(session.scalar(query.limit(1)) is not None for query in queries)


def project_of_group(session: Session, group: str) -> str | None:
    """The project in the name of a group of stage outputs; None where there is no such project."""
    parts = group.split("/")
    project = session.get(ProjectRow, parts[1]) if len(parts) == 3 else None
    return project.id if project is not None else None


def stage_of_group(group: str) -> StageName | None:
    """The stage in the name of a group of outputs; None where it says none: no stage put it there, or will take it."""
    name = group.rpartition("/")[2].partition("-")[0]
    return next((stage for stage in StageName if stage == name), None)


def open_upload(session: Session, key: str, s3_upload_id: str) -> bool:
    """Whether a multipart upload of the store is an open upload of the catalog."""
    row = session.get(UploadRow, key.split("/")[1]) if key.count("/") else None
    return row is not None and row.state is UploadState.OPEN and row.s3_upload_id == s3_upload_id
