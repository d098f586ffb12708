"""Who asks too much is told when to come back, and nobody else notices."""

import secrets

import httpx
import pytest

TOKEN = secrets.token_urlsafe(32)
UPLOAD = {"kind": "drive", "filename": "log.tar", "size": 9}


BURST = 12


@pytest.fixture(scope="module")
def strict(api_process, redis_server) -> str:
    """An API that lets each key ask so often, and again after minutes."""
    limits = {"rate_per_second": "0.001", "rate_burst": str(BURST), "failures_per_second": "0.001"}
    quotas = {"failures_burst": "3", "max_open_uploads": "2", "max_open_upload_bytes": "1000", "max_active_jobs": "1"}
    redis_url = redis_server.removesuffix("/0") + "/4"
    return api_process(token=TOKEN, redis_url=redis_url, training="1", **limits, **quotas)


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
        assert http.post("/v1/models/train", json=request | {"name": "first"}).status_code == 202
        second = http.post("/v1/models/train", json=request | {"name": "second"})
        assert refused(second, "quota-reached")["errors"][0]["where"] == "jobs"


def test_wrong_credentials_are_limited_by_address_and_right_ones_that_are_known_are_not(fresh, strict):
    with fresh() as http:
        assert http.get("/v1/me").is_success
        guesses = [httpx.get(f"{strict}/v1/me", headers={"Authorization": f"Bearer {n}"}) for n in range(6)]
        assert [answer.status_code for answer in guesses] == [401] * 3 + [429] * 3
        refused(guesses[-1], "too-many-requests")
        assert http.get("/v1/me").is_success
