"""A log with more problems than anybody reads: the first are kept, and none of what follows from the rest is lost."""

import pytest

from l3ps.errors import DriveLogError, Problem
from l3ps_api.drives.schemas import Drive
from l3ps_platform import workflow
from l3ps_platform.catalog import Catalog, bundles, drives, events

pytestmark = pytest.mark.services

DOUBTS = [Problem("no-images", f"{n}.pcd", "it has no image", "Add it.", "warning", "s", str(n)) for n in range(250)]
INFO = {"scenes": [{"name": "s", "scans": 251, "points": 9}], "scans": 251, "points": 9, "has_truth": False}
SPOILT = Problem("truncated-scan", "last.pcd", "it has 3 points", "Leave it out.", "scan", "s", "last")


def document(catalog: Catalog, id: str) -> Drive:
    with catalog.reading() as session:
        return Drive.of(drives.get(session, id))


def test_the_worst_of_very_many_problems_are_kept_and_all_are_counted(play, catalog) -> None:
    drive, model = play.drive(problems=[*DOUBTS, SPOILT], info=INFO), play.model()
    shown = document(catalog, drive)
    assert (len(shown.problems), shown.problem_count) == (100, 251)
    assert [problem.where for problem in shown.problems[:3]] == ["last.pcd", "0.pcd", "1.pcd"]
    with catalog.reading() as session:
        ready = next(event for event in events.after(session, 0, subject=drive) if event.kind == "drive.ready")
    assert ready.data["problems"] == 251
    with pytest.raises(DriveLogError, match=r"last\.pcd"), catalog.transaction() as tx:
        workflow.submit_job(tx, drive_id=drive, model=model)
    with catalog.transaction() as tx:
        workflow.submit_job(tx, drive_id=drive, model=model, skip_bad_scans=True)


def test_a_job_that_fails_with_its_drive_keeps_the_first_problems(play, catalog) -> None:
    model = play.model()
    with catalog.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", filename="d.zip", size=9, object_key="uploads/u/d.zip")
        job = workflow.submit_job(tx, drive_id=drive.id, model=model)
    errors = [Problem("bad-image", f"{n}.jpg", "it is torn", "Copy it again.") for n in range(101)]
    verdict = {"usable": False, "problems": errors}
    play.run(lambda tx, claim: workflow.drive_checked(tx, claim, workflow.Cost(1.0), **verdict))
    assert [problem["where"] for problem in play.job(job.id).error["problems"]] == [f"{n}.jpg" for n in range(100)]
    assert document(catalog, drive.id).problem_count == 101


def test_rows_of_before_show_no_more_either(play, catalog) -> None:
    drive = play.drive(info=INFO)
    with catalog.transaction() as tx:
        drives.lock(tx.session, drive).problem = {"problems": [doubt.as_dict() for doubt in DOUBTS]}
    shown = document(catalog, drive)
    assert (len(shown.problems), shown.problem_count) == (100, 250)


def test_a_model_s_problems_are_kept_the_same_way(play, catalog) -> None:
    errors = [Problem("bad-graph", f"node {n}", "it is unknown", "Export it again.") for n in range(101)]
    model = play.model(problems=errors)
    with catalog.reading() as session:
        row = bundles.get(session, model)
    assert (len(row.problem["problems"]), row.problem["count"]) == (100, 101)
