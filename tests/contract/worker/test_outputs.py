"""Stage outputs in the store: who reads which, and what is done about those that are not whole."""

from pathlib import Path

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import JobState, StageState
from l3ps_worker import keys


def retry(bench, job: str) -> None:
    """As the API does it."""
    with bench.catalog.reading() as session:
        wanted = workflow.outputs_to_keep(session, job)
    with bench.catalog.transaction() as tx:
        workflow.retry_job(tx, job, [key for key in wanted if not bench.store.exists(key)])


@pytest.fixture
def segmented(direct, short_zip: Path, fast_model: Path):
    """A bench and a job of one scene that is segmented and not refined."""
    drive = direct.upload_drive(short_zip)
    direct.upload_model(fast_model)
    direct.run()
    job = direct.submit(drive, preset="fast")
    assert direct.step() == "done"
    return direct, job


def test_a_worker_of_another_version_refines_what_was_segmented(segmented, monkeypatch: pytest.MonkeyPatch) -> None:
    """An upgrade comes between two stages of a scene."""
    bench, job = segmented
    real = keys.code_version
    monkeypatch.setattr(keys, "code_version", lambda parts=(): f"new {real(parts)}")
    assert bench.run() == ["done", "done"]
    assert bench.job(job).state is JobState.SUCCEEDED
    assert len([info for info in bench.store.list("stages/") if info.key.endswith("primal.npz")]) == 1


def test_primal_labels_that_are_gone_are_made_again_by_a_retry(segmented) -> None:
    bench, job = segmented
    primal = bench.stages(job)[0].output_key
    bench.store.delete(primal)
    assert bench.step() == "failed"
    row = bench.job(job)
    assert (row.state, "retry the job" in row.error["message"]) == (JobState.FAILED, True)
    retry(bench, job)
    assert bench.run() == ["done", "done", "done"]
    assert {stage.state for stage in bench.stages(job)} == {StageState.DONE}
    assert bench.store.exists(primal)
