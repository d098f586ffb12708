"""Uploads made to do harm: each is refused with a problem that says what to do, and nothing of it stays.

All go through the real API to a real worker, which takes them one after the other. ``make hostile`` runs every case on
both stacks; without it one stack takes every third, and fewer models.
"""

import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import select
from tests.contract.api.conftest import Service

from l3ps_platform.catalog import DriveRow, DriveState, ModelRow, ModelState

from . import cases_logs, cases_models, cases_names, cases_sizes, cases_types
from .case import FULL, ONLY, Case
from .conftest import Watch, watched
from .samples import Samples

ALL = [case for cases in (cases_names, cases_sizes, cases_types, cases_logs, cases_models) for case in cases.CASES]
SECONDS = 1200 if FULL else 120
"""For all cases of one stack; one of them takes a tenth of a second."""
MEGABYTES = 2000
"""That a process of the worker may have resident at any time."""


def chosen() -> list[Case]:
    """The cases to run."""
    if FULL:
        return [case for case in ALL if re.search(ONLY, case.name)]
    return ALL[: -len(cases_models.CASES) : 3] + cases_models.CASES[::8]  # a trial of a model takes a second


@dataclass
class Outcome:
    """What became of a case: the answer to its completion and, where that was accepted, the drive or model."""

    case: Case
    answer: httpx.Response
    document: dict[str, Any] | None = None

    @property
    def problems(self) -> list[dict[str, Any]]:
        """The problems told, wherever they were."""
        if self.document is None:
            found: list[dict[str, Any]] = self.answer.json()["errors"]
            return found
        told: list[dict[str, Any]] = self.document["problems"]
        return told


@dataclass
class Run:
    """All outcomes of a stack, and what the worker used."""

    service: Service
    outcomes: list[Outcome]
    watch: Watch
    seconds: float
    before: set[str]
    workers: set[int]


@pytest.fixture(scope="session")
def run(service: Service, samples: Samples) -> Iterator[Run]:
    """Every case of this stack uploaded, then every one waited for."""
    before = service.objects()
    start = time.monotonic()
    with watched(service.settings.data_dir) as watch, ThreadPoolExecutor(4) as hands:
        workers = {pid for pid, words in watch.processes().items() if "l3ps_worker.app" in words}
        outcomes = list(hands.map(lambda case: _uploaded(service, samples, case), chosen()))
        for outcome in outcomes:
            if outcome.answer.status_code == 202:
                outcome.document = _checked(service, outcome)
    yield Run(service, outcomes, watch, time.monotonic() - start, before, workers)


def _uploaded(service: Service, samples: Samples, case: Case) -> Outcome:
    name = {"name": case.name} if case.kind == "model" else {}
    return Outcome(case, service.upload(case.make(samples), case.name, case.kind, **name))


def _checked(service: Service, outcome: Outcome) -> dict[str, Any]:
    path = f"/v1/{outcome.case.kind}s/{outcome.answer.json()['id']}"
    return service.wait(path, lambda document: document["state"] in ("ready", "rejected"), SECONDS)


def test_there_are_many_of_them():
    assert len(ALL) >= 60 and len({case.name for case in ALL}) == len(ALL)


def test_each_is_refused_where_it_should_be_and_for_the_right_reason(run):
    wrong = []
    for outcome in run.outcomes:
        case = outcome.case
        if outcome.document is None:
            ended = "completion" if outcome.answer.status_code == 422 else f"status {outcome.answer.status_code}"
        else:
            ended = {"rejected": "check", "ready": "job"}[outcome.document["state"]]
        codes = {problem.get("code") for problem in outcome.problems}
        if outcome.document is None:
            codes.add(outcome.answer.json()["type"].removeprefix("urn:l3ps:problem:"))
        fitting = [problem for problem in outcome.problems if case.where in problem["where"]]
        if ended != case.end or not codes & case.codes or not fitting:
            wrong.append((case.name, ended, codes, outcome.problems[:2]))
    assert not wrong, "\n".join(map(str, wrong))


def test_every_problem_says_what_where_and_what_to_do_and_no_place_on_the_service(run):
    for outcome in run.outcomes:
        assert outcome.problems, outcome.case.name
        for problem in outcome.problems:
            assert problem["where"] and problem["what"] and problem["remedy"], (outcome.case.name, problem)
            text = " ".join(str(value) for value in problem.values())
            assert str(run.service.settings.data_dir) not in text and "Traceback" not in text, text
            assert len(problem["where"]) < 400 and len(problem["what"]) < 800, (outcome.case.name, problem)
            assert all(c.isprintable() for c in problem["where"]), (outcome.case.name, problem["where"])


def test_a_refusal_at_the_completion_is_a_problem_document(run):
    for outcome in run.outcomes:
        if outcome.case.end == "completion":
            Service.refused(outcome.answer, 422, "not-an-archive")


def test_a_log_of_which_only_scans_are_bad_is_refused_as_a_job(run, samples):
    from .archives import zipped

    answer = run.service.upload(zipped(samples.bundle), "good.zip", "model", name="good")
    path = f"/v1/models/{answer.json()['id']}"
    assert run.service.wait(path, lambda model: model["state"] in ("ready", "rejected"))["state"] == "ready"
    for outcome in run.outcomes:
        if outcome.case.end == "job":
            request = {"drive_id": outcome.document["id"], "model": "good"}
            document = Service.refused(run.service.http.post("/v1/jobs", json=request), 422, "unusable-input")
            assert {error["code"] for error in document["errors"]} & outcome.case.codes


def test_nothing_is_left_behind(run):
    for outcome in run.outcomes:
        if outcome.case.end == "job":
            run.service.http.delete(f"/v1/drives/{outcome.document['id']}")
    run.service.wait("/healthz", lambda _: run.service.objects() <= run.before | _good(run.service))
    assert not _open_multiparts(run.service)
    scratch = run.service.settings.scratch
    assert not list((scratch / "work").iterdir())
    bad = {outcome.case.name for outcome in run.outcomes if outcome.case.end != "job"}
    assert not [path for path in scratch.rglob("*evil*") if path.name in bad]
    for place in (Path("/evil"), Path("/etc/cron.d/evil"), scratch.parent / "evil", Path("/tmp/escaped.txt")):
        assert not place.exists()
    running = run.watch.processes()
    assert not [words for words in running.values() if "l3ps.segment.trial" in words]


def test_the_worker_lives_on_and_used_little(run, samples, record_testsuite_property):
    record_testsuite_property("cases", len(run.outcomes))
    record_testsuite_property("seconds", round(run.seconds, 1))
    record_testsuite_property("peak_mb", round(max(run.watch.peaks.values())))
    assert run.workers and run.workers <= set(run.watch.processes()), "no process died"
    assert max(run.watch.peaks.values()) < MEGABYTES, run.watch.peaks
    assert run.seconds < SECONDS
    answer = run.service.upload(samples.zip(), "after-all.zip")
    drive = run.service.wait_for_drive(answer.json()["id"])
    assert drive["state"] == "ready" and not drive["problems"]


def _good(service: Service) -> set[str]:
    """Keys of the archives of what is ready."""
    with service.catalog.reading() as session:
        drives = session.scalars(select(DriveRow.object_key).where(DriveRow.state == DriveState.READY)).all()
        models = session.scalars(select(ModelRow.object_key).where(ModelRow.state == ModelState.READY)).all()
    return {key for key in (*drives, *models) if key is not None}


def _open_multiparts(service: Service) -> list[Any]:
    """Uploads in parts that the store still holds."""
    store: Any = service.store
    if service.settings.objects_url:
        uploads = store._client._list_multipart_uploads(store._bucket).uploads
        return list(uploads)
    return list((service.settings.data_dir / "objects" / "multipart").glob("*"))
