"""Every error of the API is a problem document that names the field and the remedy."""

import socket
from collections.abc import Iterator

import httpx
import pytest

from l3ps_platform.catalog import drives


def test_an_unknown_route_points_to_the_list_of_routes(service):
    document = service.refused(service.http.get("/v1/nothing"), 404, "not-found")
    assert "/v1/nothing" in document["detail"] and "/openapi.json" in document["detail"]


def test_a_wrong_method_names_the_right_ones(service):
    answer = service.http.put("/v1/jobs")
    document = service.refused(answer, 405, "method-not-allowed")
    assert "PUT" in document["detail"]
    assert answer.headers["allow"] == "GET, POST", "all of them, whichever route they belong to"


def test_a_body_that_is_no_json(service):
    answer = service.http.post("/v1/jobs", content=b"{nonsense", headers={"content-type": "application/json"})
    assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "body"


def test_every_field_at_fault_is_named_with_its_remedy(service):
    answer = service.http.post("/v1/uploads", json={"kind": "song", "size": -1, "colour": "red"})
    document = service.refused(answer, 422, "invalid-request")
    faults = {error["where"]: error for error in document["errors"]}
    assert set(faults) == {"kind", "filename", "size", "colour"}
    assert "'drive'" in faults["kind"]["what"]
    assert faults["filename"]["remedy"] == "Add it."
    assert "Remove it" in faults["colour"]["remedy"]


def test_a_query_parameter_at_fault_is_named(service):
    document = service.refused(service.http.get("/v1/jobs", params={"limit": 0}), 422, "invalid-request")
    assert document["errors"][0]["where"] == "query limit"


@pytest.mark.parametrize("kind", ["drive", "job", "model"])
def test_what_does_not_exist_is_a_404_of_its_kind(service, kind):
    document = service.refused(service.http.get(f"/v1/{kind}s/none"), 404, f"unknown-{kind}")
    assert f"/v1/{kind}s" in document["detail"]


def test_a_json_body_that_is_too_large_is_refused_unread_whether_or_not_it_says_so(service):
    body = b" " * (3 << 20)
    service.refused(service.http.post("/v1/jobs", content=body), 413, "too-large")

    def chunks():
        for start in range(0, len(body), 1 << 16):
            yield body[start : start + (1 << 16)]

    answer = service.http.post("/v1/jobs", content=chunks(), headers={"content-type": "application/json"})
    assert answer.status_code == 413
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("content", [b"hello", b'"hello"', b"[]"])
def test_what_is_no_json_object_is_told_so_in_plain_words(service, content):
    document = service.refused(service.http.post("/v1/jobs", content=content), 422, "invalid-request")
    assert "Send" in document["detail"] and "JSON object" in document["detail"]
    assert document["errors"][0]["where"] == "body"


def test_a_loopback_service_answers_only_to_loopback_names(service):
    answer = service.http.get("/healthz", headers={"host": "evil.example"})
    assert "evil.example" in service.refused(answer, 421, "foreign-host")["detail"]


def test_a_fault_of_the_service_says_so_and_tells_no_inner_detail(service):
    with service.catalog.transaction() as tx:
        row = drives.add(tx, name="broken", filename="x.tar", size=1, object_key="uploads/x")
        row.info = {"secret": "unreadable"}
    answer = service.http.get(f"/v1/drives/{row.id}")
    with service.catalog.transaction() as tx:
        tx.session.delete(drives.get(tx.session, row.id))
    service.refused(answer, 500, "internal")
    assert "secret" not in answer.text and "Traceback" not in answer.text


def test_openapi_names_the_problem_document_as_every_operations_error(service):
    document = service.http.get("/openapi.json").json()
    assert "HTTPValidationError" not in document["components"]["schemas"]
    assert "ErrorItem" in document["components"]["schemas"]
    for operations in document["paths"].values():
        for operation in operations.values():
            content = operation["responses"]["default"]["content"]["application/problem+json"]
            assert content["schema"]["$ref"] == "#/components/schemas/ProblemDocument"
            for status in operation["responses"].keys() & {"401", "403", "404", "409", "412", "413", "422", "429"}:
                named = operation["responses"][status]["$ref"].rpartition("/")[2]
                assert (
                    document["components"]["responses"][named]["content"]
                    == operation["responses"]["default"]["content"]
                )
    assert service.http.get("/docs").is_success


def test_healthy_ready_and_measured(service):
    assert service.http.get("/healthz").json() == {"status": "ok"}
    assert service.http.get("/readyz").json() == {
        "status": "ready",
        "checks": {"catalog": "ok", "store": "ok", "queue": "ok"},
    }
    service.http.get("/v1/jobs/none")
    metrics = service.http.get("/metrics").text
    assert 'l3ps_http_requests_total{method="GET",route="/v1/jobs/{job_id}",status="404"}' in metrics
    assert "l3ps_http_request_seconds_bucket" in metrics
    assert "/v1/jobs/none" not in metrics


@pytest.fixture(scope="module")
def nobody_there() -> Iterator[str]:
    """An address that refuses connections."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused and nobody else takes it
        yield f"127.0.0.1:{closed.getsockname()[1]}"


@pytest.fixture(scope="module")
def cut_off(api_process, nobody_there) -> str:
    """An API whose database, object store and queue all refuse connections."""
    return api_process(
        database_url=f"postgresql://nobody:nothing@{nobody_there}/none",
        objects_url=f"s3://KEY:SECRETSECRET@{nobody_there}/none?secure=0",
        redis_url=f"redis://{nobody_there}/0",
    )


def test_a_service_cut_off_lives_and_says_what_is_missing(service, cut_off):
    assert httpx.get(f"{cut_off}/healthz").is_success
    answer = httpx.get(f"{cut_off}/readyz", timeout=30)
    document = service.refused(answer, 503, "not-ready")
    assert {error["where"] for error in document["errors"]} == {"catalog", "store", "queue"}
    assert {error["what"] for error in document["errors"]} == {"it does not answer"}
    assert "127.0.0.1" not in answer.text, "where they are is nothing for strangers"
    assert int(answer.headers["retry-after"]) > 0


def test_what_cannot_be_done_now_may_be_tried_again(service, cut_off):
    answer = httpx.get(f"{cut_off}/v1/drives", timeout=30)
    service.refused(answer, 503, "catalog-unavailable")
    assert int(answer.headers["retry-after"]) > 0


def test_an_upload_without_an_object_store_may_be_tried_again(service, api_process, nobody_there):
    api = api_process(objects_url=f"s3://KEY:SECRETSECRET@{nobody_there}/none?secure=0")
    upload = {"kind": "drive", "filename": "log.tar", "size": 10}
    answer = httpx.post(f"{api}/v1/uploads", json=upload, timeout=30)
    service.refused(answer, 503, "object-store-unavailable")
    assert int(answer.headers["retry-after"]) > 0
    assert "SECRETSECRET" not in answer.text


def test_a_foreign_web_page_cannot_post(service):
    """A browser sends JSON across sites only after asking, which is refused; as plain text it is no JSON here."""
    body = b'{"kind": "drive", "filename": "log.tar", "size": 10}'
    headers = {"origin": "https://evil.example", "content-type": "text/plain"}
    service.refused(service.http.post("/v1/uploads", content=body, headers=headers), 422, "invalid-request")
    asking = {"origin": "https://evil.example", "access-control-request-method": "POST"}
    answer = service.http.options("/v1/uploads", headers=asking)
    assert answer.is_error and "access-control-allow-origin" not in answer.headers
