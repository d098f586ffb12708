"""Every object of the bucket belongs to somebody: to a row that names it, or to an output that a row knows."""

import json
from pathlib import PurePosixPath

from chaoslib.stack import Service
from l3ps_platform.catalog import (
    AnnotationsRow,
    DriveRow,
    JobRow,
    ModelRow,
    StageName,
    StageRow,
    StageState,
    TrainingRow,
    UploadState,
)
from l3ps_platform.catalog.belongings import group_of
from l3ps_platform.catalog.models import UploadRow
from l3ps_platform.catalog.output_rows import OutputRow
from l3ps_platform.catalog.states import OutputState


def check(service: Service) -> None:
    """Nothing in the bucket that no row accounts for, and nothing missing of what rows promise."""
    assert not service.multipart_uploads(), "multipart uploads left"
    open_uploads = [row.id for row in service.rows(UploadRow, UploadRow.state == UploadState.OPEN)]
    assert not open_uploads, f"uploads left open: {open_uploads}"
    there = {info.key for info in service.store.list()}
    named = _named(service)
    assert named <= there, f"promised and not there: {sorted(named - there)}"
    outputs = {row.key: row for row in service.rows(OutputRow)}
    doomed = [key for key, row in outputs.items() if row.state is OutputState.DOOMED]
    assert not doomed, f"outputs that nobody deletes: {doomed}"
    # What a lost, cancelled or failed attempt had stored belongs to its output's row, and goes with it.
    spare = {key for key in there - named if group_of(key) in outputs}
    orphans = there - named - spare
    service.note("orphans", len(orphans))
    assert not orphans, f"objects that belong to nobody: {sorted(orphans)}"
    service.note("objects of lost attempts", len(spare))


def _named(service: Service) -> set[str]:
    """Every object that a row of something that is not deleted names, itself or by its manifest."""
    deleted = {job.id for job in service.rows(JobRow, JobRow.deleted_at.is_not(None))}
    archives = [*service.rows(DriveRow), *service.rows(ModelRow), *service.rows(AnnotationsRow)]
    found = {row.object_key for row in archives} | {row.log_key for row in service.rows(TrainingRow)}
    for stage in service.stages(StageRow.output_key.is_not(None), StageRow.state == StageState.DONE):
        if stage.output_key is None or stage.job_id in deleted:
            continue
        found.add(stage.output_key)
        if stage.name in (StageName.REFINE, StageName.PUBLISH):
            manifest = json.loads(service.store.get_bytes(stage.output_key))
            assert PurePosixPath(stage.output_key).suffix == ".json"
            found |= {file["key"] for file in manifest["files"]}
    return {key for key in found if key is not None}
