"""Queries for stage outputs and their uses."""

from __future__ import annotations

from sqlalchemy import delete as sql_delete
from sqlalchemy import exists, func, or_, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from l3ps_platform.catalog.models import DriveRow, JobRow, ModelRow, StageRow, TrainingRow
from l3ps_platform.catalog.output_rows import OutputRow, OutputUseRow
from l3ps_platform.catalog.session import Transaction, project_of
from l3ps_platform.catalog.states import ACTIVE, OutputState, StageName
from l3ps_platform.errors import OutputDoomed

MAIN = {StageName.SEGMENT: "primal.npz", StageName.REFINE: "scene.json", StageName.TRAIN: "bundle.zip"}
"""The object of a stage's output that is written last and deleted first: while it is there, all is there."""

_TRIES = 5


def lock(session: Session, key: str) -> OutputRow | None:
    """One output as it is now, held against concurrent changes until the transaction ends."""
    query = select(OutputRow).where(OutputRow.key == key).with_for_update()
    return session.scalars(query, execution_options={"populate_existing": True}).one_or_none()


def hold(tx: Transaction, key: str, stage: StageName, project_id: str) -> OutputRow:
    """One output, made if there is none yet, held until the transaction ends. OutputDoomed where that does not work."""
    for _ in range(_TRIES):
        row = lock(tx.session, key)
        if row is not None:
            return row
        new = OutputRow(key=key, stage=stage, project_id=project_id, state=OutputState.LIVE, bytes=0)
        new.created_at = new.last_used_at = tx.now
        try:
            with tx.session.begin_nested():
                tx.session.add(new)
            return new
        except IntegrityError:  # somebody else made it in this moment, and may be deleting it already
            continue
    raise OutputDoomed(f"{key} is made and deleted again faster than it can be held")


def use(tx: Transaction, key: str, stage_id: str) -> None:
    """Note that a stage uses an output; the caller holds the output."""
    tx.session.merge(OutputUseRow(stage_id=stage_id, output_key=key))
    tx.session.flush()


def referred(session: Session, key: str) -> bool:
    """Whether anybody needs an output: a job that is not deleted, a training, or the model it is the bundle of."""
    job = exists().where(JobRow.id == StageRow.job_id, or_(JobRow.deleted_at.is_(None), JobRow.state.in_(ACTIVE)))
    users = select(StageRow.id).join(OutputUseRow, OutputUseRow.stage_id == StageRow.id)
    users = users.where(OutputUseRow.output_key == key, or_(StageRow.training_id.is_not(None), job))
    bundle = f"{key}/{MAIN[StageName.TRAIN]}"
    models = select(ModelRow.id).where(ModelRow.object_key == bundle, ModelRow.deleted_at.is_(None))
    return session.scalar(users.limit(1)) is not None or session.scalar(models.limit(1)) is not None


def of_job(session: Session, job_id: str) -> list[str]:
    """Keys of the outputs that a job's stages use."""
    query = select(OutputUseRow.output_key).join(StageRow).where(StageRow.job_id == job_id).distinct()
    return list(session.scalars(query.order_by(OutputUseRow.output_key)))


def of_training(session: Session, training_id: str) -> list[str]:
    """Keys of the outputs that a training uses."""
    query = select(OutputUseRow.output_key).join(StageRow).where(StageRow.training_id == training_id)
    return list(session.scalars(query))


def forget_uses(tx: Transaction, *, job_id: str | None = None, training_id: str | None = None) -> None:
    """A job or training uses nothing any more."""
    owner = StageRow.job_id == job_id if job_id is not None else StageRow.training_id == training_id
    mine = OutputUseRow.stage_id.in_(select(StageRow.id).where(owner))
    tx.session.execute(sql_delete(OutputUseRow).where(mine), execution_options={"synchronize_session": False})


def doomed(session: Session, limit: int, after: str = "") -> list[OutputRow]:
    """Outputs that are to be deleted, after the key ``after``."""
    query = select(OutputRow).where(OutputRow.state == OutputState.DOOMED, OutputRow.key > after)
    return list(session.scalars(query.order_by(OutputRow.key).limit(limit)))


def erase(tx: Transaction, key: str) -> None:
    """Delete the row of a doomed output whose objects are gone."""
    gone = OutputRow.key == key, OutputRow.state == OutputState.DOOMED
    tx.session.execute(sql_delete(OutputRow).where(*gone), execution_options={"synchronize_session": False})


def stored_bytes(session: Session, project_id: str | None = None) -> int:
    """Bytes of a project's outputs and drive archives; the project is the session's where none is given."""
    project_id = project_of(session, project_id)
    outputs = select(func.coalesce(func.sum(OutputRow.bytes), 0)).where(
        OutputRow.project_id == project_id, OutputRow.state == OutputState.LIVE
    )
    archives = select(func.coalesce(func.sum(DriveRow.size), 0)).where(
        DriveRow.project_id == project_id, DriveRow.deleted_at.is_(None), DriveRow.object_key.is_not(None)
    )
    return int(session.scalar(outputs) or 0) + int(session.scalar(archives) or 0)


def project_of_stage(session: Session, stage: StageRow) -> str:
    """The project of the job or training that a stage belongs to."""
    query = select(JobRow.project_id).where(JobRow.id == stage.job_id)
    if stage.training_id is not None:
        query = select(TrainingRow.project_id).where(TrainingRow.id == stage.training_id)
    return session.execute(query).scalar_one()
