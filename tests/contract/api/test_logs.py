"""Every line of every process is JSON, the lines of a job carry its ids, and none of them a secret."""

import json
import re

from tests.conftest import wait_until

from l3ps_platform.catalog import stages


def read(service) -> dict[str, str]:
    """What each of our processes has written so far."""
    names = ("api", "worker", "trainer")
    logs = {path.stem: path for path in (service.settings.data_dir / "logs").glob("*.log")}
    return {name: logs[name].read_text() for name in names if name in logs}


def lines(service) -> list[dict]:
    return [json.loads(line) for text in read(service).values() for line in text.splitlines()]


def answered(service, request: str) -> dict:
    """The line that a request ends with; it is written after the answer has left."""

    def ended() -> dict | None:
        wanted = ("answered", request)
        return next((line for line in lines(service) if (line["event"], line.get("request")) == wanted), None)

    line: dict = wait_until(ended)
    return line


def test_every_line_parses_and_says_who_and_when(service, observed):
    found = lines(service)
    assert {"api", "worker"} <= {line["service"] for line in found}
    for line in found:
        assert {"event", "level", "timestamp", "service", "pid"} <= line.keys(), line


def test_the_lines_of_a_job_carry_its_ids_in_every_process(service, observed):
    with service.catalog.reading() as session:
        rows = {row.id: row for row in stages.of_job(session, observed["id"])}
    found = [line for line in lines(service) if line.get("stage") in rows]
    for line in found:
        row = rows[line["stage"]]
        assert (line["job"], line.get("scene"), line["attempt"]) == (observed["id"], row.scene_id, 1), line
    done = {line["stage"] for line in found if line["event"] == "stage done"}
    assert done == set(rows), "every stage says its end"


def test_the_request_that_made_a_job_can_be_found_from_it(service, observed):
    assert observed["request"] == "test-4711", "the client's"
    found = answered(service, observed["request"])
    assert (found["method"], found["route"], found["status"]) == ("POST", "/v1/jobs", 202)
    assert found["bytes"] > 0 and found["bytes_in"] > 0 and found["seconds"] > 0
    mine = [line for line in lines(service) if line.get("request") == observed["request"]]
    assert {line["job"] for line in mine if line["event"] == "job accepted"} == {observed["id"]}


def test_requests_are_logged_by_route_and_machines_own_are_not(service, observed):
    service.http.get("/healthz")
    service.http.get("/metrics")
    given = service.http.get("/v1/jobs/job_none", headers={"X-Request-Id": "not harmless"}).headers["x-request-id"]
    assert re.fullmatch("req_[0-9a-f]{16}", given)
    refused = service.http.get("/v1/jobs?secret=in-the-query").headers["x-request-id"]
    found = answered(service, given)
    assert (found["route"], found["job"], found["status"]) == ("/v1/jobs/{job_id}", "job_none", 404)
    assert answered(service, refused)["status"] == 422
    routes = {line["route"] for line in lines(service) if line["event"] == "answered"}
    assert not routes & {"/healthz", "/readyz", "/metrics"}
    assert "in-the-query" not in "".join(read(service).values())


def test_no_line_holds_a_secret(service, observed):
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
