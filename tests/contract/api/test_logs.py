"""Every line of every process is JSON, the lines of a job carry its ids, and none of them a secret."""

import json
import re

import pytest

from l3ps_cli.packing import pack_bundle, pack_log
from l3ps_platform.catalog import stages

REQUEST = "test-4711"


@pytest.fixture(scope="module")
def job(service, drive_log, bundle, tmp_path_factory) -> dict:
    """A job that nothing is known of yet, submitted under a request id of the client's."""
    folder = tmp_path_factory.mktemp("logs")
    pack_log(drive_log, folder / "log.tar")
    pack_bundle(bundle, folder / "model.zip")
    model = service.upload((folder / "model.zip").read_bytes(), "model.zip", "model", name="logged").json()
    drive = service.upload((folder / "log.tar").read_bytes() + bytes(512), "log.tar").json()
    service.wait(f"/v1/models/{model['id']}", lambda document: document["state"] == "ready")
    request = {"drive_id": drive["id"], "model": "logged", "preset": "fast"}
    answer = service.http.post("/v1/jobs", json=request, headers={"X-Request-Id": REQUEST})
    assert answer.headers["x-request-id"] == REQUEST
    return service.wait_for_job(answer.json()["id"])


def read(service) -> dict[str, str]:
    """What each of our processes has written so far."""
    names = ("api", "worker", "trainer")
    logs = {path.stem: path for path in (service.settings.data_dir / "logs").glob("*.log")}
    return {name: logs[name].read_text() for name in names if name in logs}


def lines(service) -> list[dict]:
    return [json.loads(line) for text in read(service).values() for line in text.splitlines()]


def test_every_line_parses_and_says_who_and_when(service, job):
    found = lines(service)
    assert {"api", "worker"} <= {line["service"] for line in found}
    for line in found:
        assert {"event", "level", "timestamp", "service", "pid"} <= line.keys(), line


def test_the_lines_of_a_job_carry_its_ids_in_every_process(service, job):
    with service.catalog.reading() as session:
        rows = {row.id: row for row in stages.of_job(session, job["id"])}
    found = [line for line in lines(service) if line.get("stage") in rows]
    for line in found:
        row = rows[line["stage"]]
        assert (line["job"], line.get("scene"), line["attempt"]) == (job["id"], row.scene_id, 1), line
    done = {line["stage"] for line in found if line["event"] == "stage done"}
    assert done == set(rows), "every stage says its end"


def test_the_request_that_made_a_job_can_be_found_from_it(service, job):
    mine = [line for line in lines(service) if line.get("request") == REQUEST]
    assert {line["job"] for line in mine if line["event"] == "job accepted"} == {job["id"]}
    (answered,) = [line for line in mine if line["event"] == "answered"]
    assert (answered["method"], answered["route"], answered["status"]) == ("POST", "/v1/jobs", 202)
    assert answered["bytes"] > 0 and answered["bytes_in"] > 0 and answered["seconds"] > 0


def test_requests_are_logged_by_route_and_machines_own_are_not(service, job):
    service.http.get("/healthz")
    service.http.get("/metrics")
    service.http.get("/v1/jobs/job_none?secret=in-the-query", headers={"X-Request-Id": "not harmless"})
    answered = [line for line in lines(service) if line["event"] == "answered"]
    assert not [line for line in answered if line["route"] in ("/healthz", "/readyz", "/metrics")]
    last = answered[-1]
    assert (last["route"], last["job"], last["status"]) == ("/v1/jobs/{job_id}", "job_none", 404)
    assert re.fullmatch("req_[0-9a-f]{16}", last["request"])
    assert "in-the-query" not in "".join(read(service).values())


def test_no_line_holds_a_secret(service, job):
    service.http.get("/v1/jobs", headers={"Authorization": "Bearer a-client's-guess-of-a-token"})
    written = "".join(read(service).values())
    secrets = {"guess-of-a-token", "tester-secret"}
    config = service.settings.data_dir / "redis" / "redis.conf"
    if config.is_file():
        secrets |= set(re.findall(r"^requirepass (.+)$", config.read_text(), re.MULTILINE))
    if service.settings.token is not None:
        secrets.add(service.settings.token.get_secret_value())
    assert [secret for secret in secrets if secret in written] == []
    assert re.findall(r"X-Amz-Signature=[0-9a-f]+", written) == []
