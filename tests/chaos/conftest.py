"""``make chaos``: real processes killed and servers taken away under at least twenty small jobs.

Not part of ``make test``: it takes minutes. ``L3PS_CHAOS_CACHE=folder`` keeps the simulated drives and the baseline.
"""

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest

if not os.environ.get("L3PS_CHAOS"):
    collect_ignore_glob = ["*"]
sys.path.insert(0, str(Path(__file__).parent))

if os.environ.get("L3PS_CHAOS"):
    from chaoslib import checks, report, workload
    from chaoslib.embedded import Embedded
    from chaoslib.servers import Minio, Postgres, Redis
    from chaoslib.stack import Servers, Service

    from l3ps_platform.catalog import JobState
    from l3ps_worker.keys import code_version

IN_FLIGHT = 20
_results: list[dict[str, Any]] = []


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> "workload.Workload":
    """The archives that every scenario uploads."""
    kept = os.environ.get("L3PS_CHAOS_CACHE")
    return workload.make(Path(kept) if kept else tmp_path_factory.mktemp("workload"))


@pytest.fixture(scope="session")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator["Servers"]:
    """PostgreSQL and MinIO for all scenarios; Redis is each one's own."""
    folder = tmp_path_factory.mktemp("servers")
    postgres, minio = Postgres(), Minio(folder / "minio")
    try:
        postgres.start()
        minio.start()
        yield Servers(Redis(folder / "redis"), minio, postgres)
    finally:
        minio.stop()
        postgres.stop()
        shutil.rmtree(folder / "minio", ignore_errors=True)


class Scenario:
    """Makes the service of one scenario and sees it to its end."""

    def __init__(self, request: pytest.FixtureRequest, folder: Path, servers: "Servers", work: Any) -> None:
        self.facts: dict[str, Any] = {}
        self._given = (folder, servers, work)
        request.node.stash[_FACTS] = self.facts
        self.service: Service | None = None

    def note(self, name: str, value: object) -> None:
        """Keep a figure; of the jobs in flight the smallest, of the seconds to the end the first."""
        known = self.facts.get(name, value)
        first = known if name == "seconds to the end" else value
        self.facts[name] = min(known, value) if name == "in flight" else first

    def __call__(self, *, aof: bool = True, **options: Any) -> "Service":
        folder, servers, work = self._given
        shutil.rmtree(folder / "redis", ignore_errors=True)
        servers.redis = Redis(folder / "redis")
        servers.redis.aof = aof
        servers.redis.start()
        self.service = Service(folder, servers, work, self.note, **options)
        return self.service

    def embedded(self, **options: Any) -> "Embedded":
        """`l3ps up` instead of servers and services one by one."""
        folder, servers, work = self._given
        self.service = service = Embedded(folder, servers, work, self.note, **options)
        return service

    def stop(self) -> None:
        """Stop everything of the scenario and see that nothing of it lives on."""
        if self.service is not None:
            try:
                self.service.close()
            finally:
                self.service.servers.redis.stop()


_FACTS = pytest.StashKey[dict[str, Any]]()


@pytest.fixture
def scenario(request: pytest.FixtureRequest, tmp_path: Path, servers: "Servers", work: Any) -> Iterator[Scenario]:
    """See :class:`Scenario`."""
    one = Scenario(request, tmp_path, servers, work)
    try:
        yield one
    finally:
        one.stop()
    for log in sorted((tmp_path / "logs").glob("*.log")):
        print(f"--- {log.name}\n{log.read_text(errors='replace')[-3000:]}")  # noqa: T201  (pytest shows it on failure)


@pytest.fixture(scope="session")
def baseline(tmp_path_factory: pytest.TempPathFactory, servers: "Servers", work: Any) -> "dict[Any, checks.Labels]":
    """Labels of every case, from one run that nothing disturbs (or from the cache, for the same code)."""
    kept = os.environ.get("L3PS_CHAOS_CACHE")
    cache = Path(kept, f"baseline-{code_version()[:16]}.json") if kept else None
    if cache is not None and cache.exists():
        return {workload.Case(*case): found for case, found in json.loads(cache.read_text())}
    folder = tmp_path_factory.mktemp("baseline")
    servers.redis = Redis(folder / "redis")
    servers.redis.start()
    service = Service(folder, servers, work, lambda name, value: None)
    try:
        service.begin()
        service.start_worker(concurrency=2)
        service.wait()
        found = {case: checks.labels(service, job) for job, case in service.jobs.items()}
        if cache is not None:
            cache.write_text(json.dumps([(astuple(case), files) for case, files in found.items()]))
        return found
    finally:
        service.close()
        servers.redis.stop()


@pytest.fixture
def ends_well(scenario: Scenario, baseline: Any) -> Callable[..., None]:
    """Waits for all jobs, checks all there is to check, stops the service and checks what is left of it."""

    def end(service: "Service", expected: "dict[str, JobState] | None" = None) -> None:
        service.wait()
        checks.check(service, baseline, expected or {})
        scenario.stop()
        checks.gone(service)
        assert scenario.facts["in flight"] >= IN_FLIGHT, f"only {scenario.facts['in flight']} jobs were in flight"

    return end


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Any:
    """Note how a scenario went."""
    outcome = yield
    if outcome.when == "call" or (outcome.when == "setup" and not outcome.passed):
        why = str(outcome.longrepr[2]) if outcome.skipped else str(call.excinfo.value) if call.excinfo else ""
        verdict = "pending" if outcome.skipped else "held" if outcome.passed else "BROKEN"
        doc = (item.function.__doc__ or "").split("\n\n")[0]  # type: ignore[attr-defined]
        _results.append(
            {
                "scenario": item.name.removeprefix("test_"),
                "what": " ".join(doc.split()),
                "facts": item.stash.get(_FACTS, {}),
                "seconds": round(outcome.duration, 1),
                "verdict": verdict,
                "why": why[:400],
            }
        )
    return outcome


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the report."""
    if _results:
        report.write(session.config.rootpath, _results)
