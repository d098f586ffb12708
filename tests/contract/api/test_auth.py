"""With a token in the settings, what belongs to users answers to nobody without it."""

import httpx
import pytest
from fastapi.testclient import TestClient
from pydantic import SecretStr

from l3ps_api.app import create_app

TOKEN = "a-long-enough-token"


@pytest.fixture(scope="module")
def guarded(api_process, redis_server) -> str:
    return api_process(token=TOKEN, redis_url=redis_server.removesuffix("/0") + "/2")


@pytest.mark.parametrize("path", ["/v1/drives", "/v1/jobs", "/v1/models", "/v1/jobs/x/labels", "/v1/uploads/x"])
@pytest.mark.parametrize("header", [None, "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x", "Bearer ünknown"])
def test_without_the_token_nothing_is_told(guarded, path, header):
    headers = {"authorization": header.encode()} if header else {}
    answer = httpx.get(f"{guarded}{path}", headers=headers)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    document = answer.json()
    assert document["type"] == "urn:l3ps:problem:unauthorized"
    assert "L3PS_TOKEN" in document["errors"][0]["remedy"]


def test_with_the_token_everything_answers(guarded):
    with httpx.Client(base_url=guarded, headers={"authorization": f"Bearer {TOKEN}"}) as http:
        assert http.get("/v1/drives").is_success


def test_health_and_metrics_need_no_token(guarded):
    assert httpx.get(f"{guarded}/healthz").is_success
    assert httpx.get(f"{guarded}/readyz").is_success
    assert httpx.get(f"{guarded}/metrics").is_success


def test_metrics_want_their_own_token_where_they_have_one(service):
    api = create_app(service.settings.model_copy(update={"metrics_token": SecretStr("scraper")}))
    http = TestClient(api, base_url="http://127.0.0.1")
    for header in ({}, {"authorization": "Bearer scrape"}, {"authorization": f"Bearer {service.token}"}):
        refused = service.refused(http.get("/metrics", headers=header), 401, "unauthorized")
        assert "L3PS_METRICS_TOKEN" in refused["errors"][0]["remedy"]
    assert "l3ps_jobs" in http.get("/metrics", headers={"authorization": "Bearer scraper"}).text
    assert http.get("/readyz").status_code != 401, "probes have none"


def test_presigned_urls_carry_their_own_permission(guarded):
    with httpx.Client(base_url=guarded, headers={"authorization": f"Bearer {TOKEN}"}) as http:
        upload = http.post("/v1/uploads", json={"kind": "drive", "filename": "log.tar", "size": 3}).json()
    assert httpx.put(upload["parts"][0]["url"], content=b"abc").is_success
