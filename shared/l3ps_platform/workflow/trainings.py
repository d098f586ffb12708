"""A training from request to model: one stage, and what its ends mean."""

from __future__ import annotations

from sqlalchemy import select, update

from l3ps.errors import Problem
from l3ps_platform.catalog import annotation_sets, bundles, trainings
from l3ps_platform.catalog.base import Json
from l3ps_platform.catalog.models import StageRow, TrainingRow
from l3ps_platform.catalog.session import Transaction
from l3ps_platform.catalog.states import JobState, ModelState, StageName, StageState
from l3ps_platform.errors import Conflict, LeaseLost
from l3ps_platform.ids import new_id
from l3ps_platform.workflow import notices
from l3ps_platform.workflow.attempts import Cost
from l3ps_platform.workflow.claims import Claim, changed, owned
from l3ps_platform.workflow.outcomes import cancelled, fail, finish
from l3ps_platform.workflow.planning import add_stage, enqueue
from l3ps_platform.workflow.settling import settle_training


def submit_training(
    tx: Transaction, *, name: str, annotations_id: str, settings: Json, validation_id: str | None = None
) -> TrainingRow:
    """A new training; or, asked for once more, the same one that is under way or has become the model of this name.

    Args:
        tx: the transaction.
        name: what the model is to be called.
        annotations_id: what to learn from.
        settings: for the trainer, as :class:`~l3ps_platform.catalog.TrainingRow` keeps them.
        validation_id: what to measure on, if other annotations.

    Raises:
        NotFound: no such annotations.
        Conflict: the name belongs to another model, or will.
    """
    for id in sorted({annotations_id, validation_id or annotations_id}):
        annotation_sets.lock(tx.session, id)
    asked = (annotations_id, validation_id, settings)
    holder = bundles.named(tx.session, name)
    if holder is not None and holder.state is not ModelState.REJECTED:
        made_it = trainings.of_model(tx.session, holder.id)
        if made_it is not None and asked == (made_it.annotations_id, made_it.validation_id, made_it.settings):
            return made_it
        raise Conflict(f"there is a model named {name!r} already: choose another name")
    under_way = trainings.unfinished(tx.session, name)
    if under_way is not None:
        same = asked == (under_way.annotations_id, under_way.validation_id, under_way.settings)
        if same and not under_way.cancel_requested:
            return under_way
        raise Conflict(f"training {under_way.id} is to become model {name!r}: choose another name, or cancel it first")
    row = TrainingRow(
        id=new_id("trn"),
        name=name,
        annotations_id=annotations_id,
        validation_id=validation_id,
        settings=settings,
        state=JobState.QUEUED,
        cancel_requested=False,
        created_at=tx.now,
    )
    tx.session.add(row)
    tx.session.flush()
    notices.of_parent(tx, row)
    enqueue(tx, add_stage(tx, StageName.TRAIN, training_id=row.id))
    return row


def cancel_training(tx: Transaction, training_id: str) -> TrainingRow:
    """Stop a training at its next sign of progress; one that is over stays as it is. NotFound."""
    training = trainings.lock(tx.session, training_id)
    if training.state.final:
        return training
    training.cancel_requested = True
    idle = (StageState.WAITING, StageState.QUEUED)
    stop = update(StageRow).where(StageRow.training_id == training_id, StageRow.state.in_(idle))
    changed(tx, stop.values(state=StageState.CANCELLED, finished_at=tx.now))
    settle_training(tx, training)
    return training


def note_training(tx: Transaction, claim: Claim, *, figures: Json | None = None, log_key: str | None = None) -> None:
    """Record what is known of a training that runs; what is None stays as it was. LeaseLost."""
    training = trainings.lock(tx.session, _id(claim))
    if tx.session.scalar(select(StageRow.id).where(*owned(claim))) is None:
        raise LeaseLost(f"stage {claim.stage_id} attempt {claim.attempt} now belongs to another worker")
    if figures is not None:
        training.figures = figures
    if log_key is not None:
        training.log_key = log_key
    tx.session.flush()


def training_done(
    tx: Transaction,
    claim: Claim,
    cost: Cost,
    *,
    object_key: str,
    size: int,
    sha256: str,
    info: Json,
    report: Json,
) -> None:
    """A model is trained and checked: register it. LeaseLost.

    Fails the training where the name was taken meanwhile; the bundle stays in the store, so that the same training
    under another name costs nothing. A training that was to be cancelled registers nothing.

    Args:
        tx: the transaction.
        claim: the stage.
        cost: what it cost.
        object_key, size, sha256: of the zipped bundle.
        info: what the check of the bundle found.
        report: the trainer's.
    """
    # In the order in which all take their locks: models before trainings before stages.
    row = trainings.get(tx.session, _id(claim))
    name = row.name
    try:
        with tx.session.begin_nested():
            file = {"filename": f"{name}.zip", "size": size, "object_key": object_key, "sha256": sha256}
            model = bundles.add(tx, name=name, project_id=row.project_id, **file)  # type: ignore[arg-type]
    except Conflict as error:
        remedy = "Start the same training under another name; it is done already and takes a moment."
        problem = Problem("name-taken", "name", str(error).partition(":")[0], remedy)
        fail(tx, claim, {"message": str(problem), "problems": [problem.as_dict()]}, cost=cost)
        return
    training = trainings.lock(tx.session, _id(claim))
    if training.cancel_requested:
        tx.session.delete(model)
        cancelled(tx, claim, cost)
        return
    model.state, model.info = ModelState.READY, {**info, "training": training.id, "report": report}
    finish(tx, claim, StageState.DONE, cost=cost, output_key=object_key)
    training.model_id, training.report = model.id, report
    notices.of_upload(tx, model)
    settle_training(tx, training)


def _id(claim: Claim) -> str:
    if claim.training_id is None:
        raise ValueError("the stage has no training")
    return claim.training_id
