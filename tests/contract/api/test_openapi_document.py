"""The API keeps to its own OpenAPI document, whatever is sent: no 5xx and no answer that is not in it.

A few requests an operation here; ``make fuzz-api`` sends more.
"""

import os
import secrets
import sys
from collections import defaultdict
from contextlib import nullcontext, suppress

import httpx
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

EXAMPLES = int(os.environ.get("L3PS_FUZZ_EXAMPLES", "3"))
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
TOKEN = secrets.token_urlsafe(32)
CREDENTIALS = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def url(api_process, redis_server) -> str:
    """An API of its own without a worker: what is sent here is for the API to refuse, not for a worker to do."""
    redis_url = redis_server.removesuffix("/0") + "/3"
    limits = {"rate_per_second": "1000000", "rate_burst": "1000000"}
    return api_process(token=TOKEN, redis_url=redis_url, training="1", **limits)


@pytest.fixture(scope="module")
def document(url) -> dict:
    """The OpenAPI document without its answers for any other status: every status must be named."""
    found = httpx.get(f"{url}/openapi.json").json()
    for operations in found["paths"].values():
        for operation in operations.values():
            del operation["responses"]["default"]
    return found


@pytest.fixture(scope="module")
def known(url, document) -> dict[str, str]:
    """An id that exists for each path parameter that can have one: without them most answers were 404."""
    with httpx.Client(base_url=url, headers=CREDENTIALS) as http:
        for kind, filename in (("drive", "log.zip"), ("model", "m.zip"), ("annotations", "a.zip"), ("drive", "b.zip")):
            upload = http.post("/v1/uploads", json={"kind": kind, "filename": filename, "size": 4}).json()
            if filename == "b.zip":
                continue  # this one stays open
            etag = httpx.put(upload["parts"][0]["url"], content=b"PK\x03\x04").headers["etag"]
            body = {"parts": [{"number": 1, "etag": etag}], "name": kind}
            made = http.post(f"/v1/uploads/{upload['id']}/complete", json=body)
            assert made.is_success, made.text
            if kind == "drive":
                drive_id = made.json()["id"]
        http.post("/v1/jobs", json={"drive_id": drive_id, "model": "model"})
        http.post("/v1/models/train", json={"name": "t", "annotations": made.json()["id"], "backbone": "scratch"})
        http.post("/v1/projects", json={"name": "fuzz"})
        http.post("/v1/keys", json={"name": "fuzz", "scope": "read"})
        found = {"upload_id": upload["id"]}
        for path, operations in document["paths"].items():
            collection = path.removeprefix("/v1/")
            if "get" not in operations or "/" in collection or _streams(operations["get"]):
                continue
            if (answer := http.get(path)).is_success:
                for item in answer.json().get("items", ())[:1]:
                    if "id" in item:
                        found |= {f"{collection}_id": item["id"], f"{collection.removesuffix('s')}_id": item["id"]}
                        found[collection.removesuffix("s")] = item["id"]
    return found


@pytest.mark.slow
def test_whatever_is_sent_is_answered_as_the_document_says(url, document, known, subtests):
    schema = schemathesis.openapi.from_dict(document)
    seen = defaultdict(set)
    with requests.Session() as session:
        for found in schema.get_all_operations():
            operation = found.ok()
            with subtests.test(operation=operation.label):
                if _streams(operation.definition.raw):
                    continue  # it never ends
                for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
                    _try_out(url, operation, mode, known, session, seen[operation.label])
    sys.stdout.write(f"{ {label: sorted(statuses) for label, statuses in seen.items()} }\n")
    for label in ("GET /v1/me", "POST /v1/keys", "GET /v1/jobs/{job_id}", "POST /v1/uploads"):
        assert min(seen[label]) < 300, f"{label} never did anything"


def _streams(operation: dict) -> bool:
    return "text/event-stream" in operation["responses"].get("200", {}).get("content", {})


def _try_out(url, operation, mode, known, session, seen) -> None:
    cases = operation.as_strategy(generation_mode=mode)
    slow = [
        HealthCheck.too_slow,
        HealthCheck.filter_too_much,
        HealthCheck.data_too_large,
        HealthCheck.large_base_example,
    ]
    phases = [Phase.explicit, Phase.generate, Phase.shrink]

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=EXAMPLES < 20, phases=phases,
        suppress_health_check=slow,
    )  # fmt: skip
    @given(case=cases)
    def check(case):
        for number, name in enumerate(sorted(case.path_parameters or ())):
            if name in known and (len(str(case.path_parameters[name])) + number) % 2:
                case.path_parameters[name] = known[name]
        if case.headers:
            case.headers.pop("L3PS-Project", None)  # a project made up would be refused before anything else is seen
        answer = case.call(base_url=url, session=session, headers=CREDENTIALS, timeout=30)
        seen.add(answer.status_code)
        case.validate_response(answer, checks=CHECKS)

    with suppress(Unsatisfiable) if mode is GenerationMode.NEGATIVE else nullcontext():  # nothing to send wrong
        check()
