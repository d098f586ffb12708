"""Stage outputs in the store: who reads which, and what is done about those that are not whole."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from l3ps_platform import workflow
from l3ps_platform.catalog import JobState, StageName, StageState, outputs
from l3ps_worker import keys, runner
from l3ps_worker import refine as refining

ROAD, PLANTS = 11, 16


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


def labels(bench) -> list[str]:
    """Keys of the stored label files."""
    return [info.key for info in bench.store.list("stages/") if "/refined/" in info.key]


def as_its_manifest_says(bench, job: str) -> bool:
    """Whether every published file is there with its checksum."""
    files = bench.manifest(job)["files"]
    return all(hashlib.sha256(bench.store.get_bytes(file["key"])).hexdigest() == file["sha256"] for file in files)


def test_labels_with_a_file_missing_are_computed_anew(segmented) -> None:
    """However it came about: a manifest alone vouches for nothing."""
    bench, job = segmented
    bench.run()
    bench.store.delete(labels(bench)[0])
    again = bench.submit(bench.job(job).drive_id, preset="fast")
    assert bench.run() == ["done", "done", "done"]
    cached = {stage.name: stage.cached for stage in bench.stages(again)}
    assert (cached[StageName.SEGMENT], cached[StageName.REFINE]) == (True, False)
    assert as_its_manifest_says(bench, again)
    assert as_its_manifest_says(bench, job), "the same files serve the first job again"


def test_labels_that_vanish_before_they_are_published_fail_the_job_and_a_retry_makes_them(segmented) -> None:
    bench, job = segmented
    assert bench.step() == "done"
    bench.store.put_bytes(labels(bench)[0], b"cut")
    assert bench.run() == ["failed"]
    row = bench.job(job)
    assert (row.state, "are gone from the store: retry the job" in row.error["message"]) == (JobState.FAILED, True)
    assert not bench.store.exists(f"jobs/{job}/manifest.json")
    retry(bench, job)
    assert set(bench.run()) == {"done"}
    assert as_its_manifest_says(bench, job)


def test_an_attempt_that_lost_its_stage_vouches_for_nothing(segmented, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut off from the catalog, but not from the store: its files may have been deleted behind it."""
    bench, _ = segmented
    message, (work, steps) = bench.sent[0], runner.WORK[StageName.REFINE]

    def cut_off(context, claim, progress):
        def report(step: str, done: int, total: int) -> None:
            if (step, done) == ("store", 1):
                with bench.catalog.transaction() as tx:
                    workflow.lease_lost(tx, message.stage_id, workflow.Retry(3, 0))

        return work(context, claim, report)

    monkeypatch.setitem(runner.WORK, StageName.REFINE, (cut_off, steps))
    assert bench.step() == "lost"
    assert labels(bench)
    assert not [info for info in bench.store.list("stages/") if info.key.endswith("scene.json")]


def test_another_machine_s_rounding_leaves_published_labels_alone(segmented, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, job = segmented
    bench.run()
    real = refining.refine_scene

    def rounded(*given, **named):
        refined = real(*given, **named)
        first, *others = refined.labels
        semantic, instance = first.semantic.copy(), first.instance.copy()
        semantic[0], instance[0] = (ROAD if semantic[0] != ROAD else PLANTS), 0
        return replace(refined, labels=[replace(first, semantic=semantic, instance=instance), *others])

    monkeypatch.setattr(refining, "refine_scene", rounded)
    stage = next(stage for stage in bench.stages(job) if stage.name is StageName.REFINE)
    bench.store.delete(stage.output_key)  # as if both had begun before there was one
    again = bench.submit(bench.job(job).drive_id, preset="fast")
    assert set(bench.run()) == {"done"}
    first, second = ({file["path"]: file["sha256"] for file in bench.manifest(id)["files"]} for id in (job, again))
    assert first.keys() == second.keys()
    assert first != second
    assert as_its_manifest_says(bench, again)
    assert as_its_manifest_says(bench, job)


def test_the_size_of_labels_is_known_though_their_worker_died_before_noting_it(segmented) -> None:
    """Retention by size counts what the rows say."""
    bench, job = segmented
    primal = bench.stages(job)[0].output_key
    with bench.catalog.transaction() as tx:
        outputs.lock(tx.session, primal.rpartition("/")[0]).bytes = 0
    again = bench.submit(bench.job(job).drive_id, preset="fast")
    bench.run()
    assert bench.stages(again)[0].cached
    with bench.catalog.transaction() as tx:
        row = outputs.lock(tx.session, primal.rpartition("/")[0])
        assert row.bytes == bench.store.stat(primal).size > 0
