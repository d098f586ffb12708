"""A failed or cancelled job runs again where it is not done, on SQLite and PostgreSQL."""

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import JobState, StageState, annotation_sets, drives, trainings
from l3ps_platform.errors import Conflict
from l3ps_platform.workflow import Cause, failure

BROKEN = failure("it broke", Cause.PROCESSING)


def again(play, job: str, **given) -> None:
    with play.catalog.transaction() as tx:
        workflow.retry_job(tx, job, **given)


def fail(tx, claim) -> None:
    workflow.fail(tx, claim, BROKEN)


@pytest.fixture
def half(play, sent) -> str:
    """A job of two scenes of which one failed; the other is published."""
    job = play.submit(scenes=2)
    play.run(fail)
    assert play.finish_all() == ["segment", "refine", "publish"]
    assert play.job(job).state is JobState.FAILED
    return job


def test_only_what_is_missing_runs_again(play, sent, half) -> None:
    before = {stage.id: stage.attempt for stage in of(play, half)}
    again(play, half)
    assert (play.job(half).state, play.job(half).error) == (JobState.QUEUED, None)
    assert play.finish_all() == ["segment", "refine", "publish"]
    assert play.job(half).state is JobState.SUCCEEDED
    rose = [stage.attempt - before[stage.id] for stage in of(play, half)]
    assert rose == [1, 1, 0, 0, 1]  # the failed scene's two stages and the publication


def test_a_message_of_before_does_not_fit(play, sent) -> None:
    job = play.submit(scenes=1)
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    late = sent.pop()
    again(play, job)
    assert play.take(late) is None
    assert play.finish_all() == ["segment", "refine", "publish"]
    assert play.job(job).state is JobState.SUCCEEDED


def test_attempts_begin_to_count_anew(play, sent, half) -> None:
    again(play, half)
    message = sent[0]
    play.run(lambda tx, claim: workflow.fail(tx, claim, BROKEN, retry=workflow.Retry(2, 0.0)))
    stage = play.stage(message.stage_id)
    assert (stage.state, stage.failures, stage.attempt) == (StageState.WAITING, 1, 3)


def test_a_job_whose_publication_failed_only_publishes(play, sent) -> None:
    job = play.submit(scenes=1)
    for _ in range(2):
        play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0), output_key=f"o/{claim.name}"))
    play.run(fail)
    again(play, job)
    assert play.finish_all() == ["publish"]
    assert play.job(job).state is JobState.SUCCEEDED


def test_outputs_that_are_gone_are_made_again(play, sent) -> None:
    job = play.submit(scenes=1)
    for _ in range(2):
        play.run(lambda tx, claim: workflow.complete(tx, claim, workflow.Cost(1.0), output_key=f"o/{claim.name}"))
    play.run(fail)
    with play.catalog.reading() as session:
        assert workflow.outputs_to_keep(session, job) == ["o/refine"]
    again(play, job, gone=["o/refine"])
    assert play.finish_all() == ["segment", "refine", "publish"]


def test_only_outputs_whose_reader_failed_are_looked_for(play, sent, half) -> None:
    """Each look is a request to the store, and a job may have 850 scenes."""

    def kept(job: str) -> list[str]:
        with play.catalog.reading() as session:
            return workflow.outputs_to_keep(session, job)

    assert kept(half) == [], "one scene is published, of the other nothing is done"
    job = play.submit(scenes=2)
    assert kept(job) == [], "it is not over"
    for outcome in ("first", "second"):
        play.run(
            lambda tx, claim, outcome=outcome: workflow.complete(tx, claim, workflow.Cost(1.0), output_key=outcome)
        )
    play.run(fail)
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    assert kept(job) == ["first"], "the other scene's refinement was cancelled before it began"


def test_a_job_cancelled_before_its_drive_was_checked_is_planned(play, sent) -> None:
    with play.catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=9, object_key="k").id
    check, model = sent.pop(), play.model()
    with play.catalog.transaction() as tx:
        job = workflow.submit_job(tx, drive_id=drive, model=model).id
    with play.catalog.transaction() as tx:
        workflow.cancel_job(tx, job)
    info = {"scenes": [{"name": "a", "scans": 1, "points": 5}]}
    done = {"usable": True, "problems": [], "sha256": "d" * 64, "format": "nuscenes", "info": info}
    play.run(lambda tx, claim: workflow.drive_checked(tx, claim, workflow.Cost(1.0), **done), check)
    assert not sent
    again(play, job)
    assert play.finish_all() == ["segment", "refine", "publish"]
    assert play.job(job).state is JobState.SUCCEEDED


@pytest.mark.parametrize("finish", [False, True], ids=["queued", "succeeded"])
def test_others_are_not_run_again(play, sent, finish: bool) -> None:
    job = play.submit(scenes=1)
    if finish:
        play.finish_all()
    with pytest.raises(Conflict, match="only a failed or cancelled job"):
        again(play, job)


def test_without_its_drive_s_archive_it_cannot_run(play, sent, half) -> None:
    with play.catalog.transaction() as tx:
        drives.delete(tx, play.job(half).drive_id)
    with pytest.raises(Conflict, match="upload it again"):
        again(play, half)


def test_a_training_runs_again(play, sent) -> None:
    with play.catalog.transaction() as tx:
        images = annotation_sets.add(tx, name="a", filename="a.zip", size=9, object_key="uploads/u/a.zip").id
        training = workflow.submit_training(tx, name="m", annotations_id=images, settings={"backbone": "scratch"}).id
    play.run(fail)
    with play.catalog.transaction() as tx:
        workflow.retry_training(tx, training)
    assert [(message.name, message.attempt) for message in sent] == [("train", 2)]
    with pytest.raises(Conflict, match="only a failed or cancelled one"), play.catalog.transaction() as tx:
        workflow.retry_training(tx, training)
    play.run(fail)
    with play.catalog.transaction() as tx:
        workflow.accept_model(tx, name="m", filename="m.zip", size=9, object_key="k")
    with pytest.raises(Conflict, match="there is a model named 'm'"), play.catalog.transaction() as tx:
        workflow.retry_training(tx, training)
    with play.catalog.reading() as session:
        assert trainings.get(session, training).state is JobState.FAILED


def of(play, job: str) -> list:
    from l3ps_platform.catalog import stages

    with play.catalog.reading() as session:
        return stages.of_job(session, job)
