"""Who asks too much is told when to come back, and nobody else notices."""

import secrets
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import httpx
import pytest
from tests.conftest import wait_until

from l3ps_api.keyring import new_secret
from l3ps_platform.ids import new_id

TOKEN = secrets.token_urlsafe(32)
UPLOAD = {"kind": "drive", "filename": "log.tar", "size": 9}


BURST = 16


@pytest.fixture(scope="module")
def strict(api_process, redis_server) -> str:
    """An API that lets each key ask so often, and again after minutes."""
    limits = {"rate_per_second": "0.001", "rate_burst": str(BURST), "failures_per_second": "0.001"}
    quotas = {"failures_burst": "3", "max_open_uploads": "2", "max_open_upload_bytes": "1000", "max_active_jobs": "1"}
    redis_url = redis_server.removesuffix("/0") + "/4"
    others = {"event_streams": "4", "trusted_proxies": "127.0.0.1", "training": "1"}
    return api_process(token=TOKEN, redis_url=redis_url, **limits, **quotas, **others)


@pytest.fixture(scope="module")
def fresh(strict):
    """Makes clients, each with a key to a project of its own."""
    with httpx.Client(base_url=strict, headers={"Authorization": f"Bearer {TOKEN}"}) as operator:
        secrets_left = []
        for number in range(BURST // 2):
            project = operator.post("/v1/projects", json={"name": f"project {number}"}).json()["id"]
            there = {"L3PS-Project": project}
            key = operator.post("/v1/keys", json={"name": "x", "scope": "write"}, headers=there).json()
            secrets_left.append(key["secret"])

    def client() -> httpx.Client:
        return httpx.Client(base_url=strict, headers={"Authorization": f"Bearer {secrets_left.pop()}"})

    return client


def refused(answer: httpx.Response, code: str) -> dict:
    assert answer.status_code == 429, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert int(answer.headers["retry-after"]) >= 1
    assert answer.json()["type"] == f"urn:l3ps:problem:{code}"
    return answer.json()


def test_the_excess_is_refused_with_the_time_to_wait_and_other_keys_go_on(fresh):
    with fresh() as greedy, fresh() as modest:
        answers = [greedy.get("/v1/drives") for _ in range(BURST + 4)]
        assert [answer.status_code for answer in answers] == [200] * BURST + [429] * 4
        refused(answers[-1], "too-many-requests")
        assert int(answers[-1].headers["retry-after"]) > 1
        assert modest.get("/v1/drives").is_success
        assert all(
            greedy.get(path).is_success for path in ("/healthz", "/readyz", "/metrics") for _ in range(BURST + 4)
        )


def test_a_project_has_so_many_open_uploads_and_may_go_on_when_one_is_closed(fresh):
    with fresh() as http:
        uploads = [http.post("/v1/uploads", json=UPLOAD) for _ in range(2)]
        key = {"Idempotency-Key": "a third one"}
        third = http.post("/v1/uploads", json=UPLOAD, headers=key)
        assert refused(third, "quota-reached")["errors"][0]["where"] == "uploads"
        assert http.delete(uploads[0].headers["location"]).status_code == 204
        again = http.post("/v1/uploads", json=UPLOAD, headers=key)
    assert again.status_code == 201, "a refusal for now is not kept with the key"


def test_a_project_has_so_many_bytes_in_open_uploads(fresh):
    """The disk is everybody's: what is announced counts, from the announcement to the completion."""
    with fresh() as http:
        first = http.post("/v1/uploads", json=UPLOAD | {"size": 900})
        document = refused(http.post("/v1/uploads", json=UPLOAD | {"size": 101}), "quota-reached")
        assert document["errors"][0]["where"] == "size" and "900 bytes" in document["errors"][0]["what"]
        assert http.delete(first.headers["location"]).status_code == 204
        assert http.post("/v1/uploads", json=UPLOAD | {"size": 101}).status_code == 201


def test_a_project_has_so_many_jobs_and_trainings_under_way(fresh):
    announced = UPLOAD | {"kind": "annotations", "size": 22}
    with fresh() as http:
        upload = http.post("/v1/uploads", json=announced).json()
        etag = httpx.put(upload["parts"][0]["url"], content=b"PK\x05\x06" + bytes(18)).headers["etag"]
        parts = {"parts": [{"number": 1, "etag": etag}]}
        annotations = http.post(f"/v1/uploads/{upload['id']}/complete", json=parts).json()["id"]
        request = {"annotations": annotations, "backbone": "scratch"}
        first = http.post("/v1/models/train", json=request | {"name": "first"})
        assert first.status_code == 202
        second = http.post("/v1/models/train", json=request | {"name": "second"})
        assert refused(second, "quota-reached")["errors"][0]["where"] == "jobs"
        path = f"/v1/trainings/{first.json()['id']}"
        assert http.post(f"{path}/cancel").json()["state"] == "cancelled"
        assert http.post("/v1/models/train", json=request | {"name": "second"}).status_code == 202
        refused(http.post(f"{path}/retry"), "quota-reached")


def test_of_the_streams_each_project_gets_a_share_however_many_are_opened_at_once(fresh, strict):
    with fresh() as greedy, fresh() as modest, ExitStack() as streams:

        def open_stream(http: httpx.Client) -> httpx.Response:
            return streams.enter_context(http.stream("GET", "/v1/events"))

        with ThreadPoolExecutor(BURST - 4) as pool:
            answers = list(pool.map(open_stream, [greedy] * (BURST - 4)))
        opened = [answer for answer in answers if answer.status_code == 200]
        assert len(opened) == 2, "half of the four"
        refusal = next(answer for answer in answers if answer.status_code != 200)
        refusal.read()
        refused(refusal, "too-many-streams")
        assert open_stream(modest).status_code == 200
        opened[0].close()
        wait_until(lambda: "l3ps_event_streams 2.0" in httpx.get(f"{strict}/metrics").text)
        assert open_stream(greedy).status_code == 200


def test_wrong_credentials_are_limited_by_address_and_right_ones_pass_all_the_same(fresh, strict):
    """Also right ones that the process has not seen before: their holder may share an address with whoever guesses."""
    guesses = [guess(strict, str(n)) for n in range(3)] + [guess(strict, new_secret(new_id("key"))) for _ in range(3)]
    assert [answer.status_code for answer in guesses] == [401] * 3 + [429] * 3
    refused(guesses[-1], "too-many-requests")
    with fresh() as http:
        assert [http.get("/v1/me").status_code for _ in range(3)] == [200] * 3
    assert guess(strict, "one more").status_code == 429


def test_behind_a_known_proxy_clients_are_told_apart_by_the_address_it_names(strict):
    there, elsewhere = ({"X-Forwarded-For": address} for address in ("198.51.100.1", "198.51.100.2"))
    assert [guess(strict, "x", there).status_code for _ in range(5)] == [401] * 3 + [429] * 2
    assert guess(strict, "x", elsewhere).status_code == 401


def guess(url: str, secret: str, headers: dict | None = None) -> httpx.Response:
    return httpx.get(f"{url}/v1/me", headers={"Authorization": f"Bearer {secret}"} | (headers or {}))
