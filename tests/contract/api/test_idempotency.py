"""A POST with an Idempotency-Key happens once, however often and at whatever moment it is repeated."""

import json
import secrets
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import httpx
import pytest
from sqlalchemy import select

from l3ps_api.idempotency import MOST_KEYS, fingerprint
from l3ps_api.keyring import Principal
from l3ps_platform.catalog import DEFAULT_PROJECT, RequestRow, UploadRow, keys, projects, requests, uploads
from l3ps_platform.ids import new_id


@pytest.fixture
def key() -> dict:
    return {"Idempotency-Key": secrets.token_hex(16)}


@pytest.fixture
def upload() -> dict:
    return {"kind": "drive", "filename": f"{secrets.token_hex(8)}.tar", "size": 9}


def post(service, path, body, key) -> httpx.Response:
    return service.http.post(path, json=body, headers=key)


def made(service, upload) -> list[UploadRow]:
    with service.catalog.reading() as session:
        return list(session.scalars(select(UploadRow).where(UploadRow.filename == upload["filename"])))


def begun(service, path: str, body: dict, key: dict, lease_seconds: float) -> requests.Held:
    """What an API process does when it takes up this request."""
    content = httpx.Request("POST", "http://x", json=body).content
    operator = Principal(DEFAULT_PROJECT, "admin")
    asked = fingerprint(operator, {"raw_path": path.encode(), "path": path, "query_string": b""}, content)
    with service.catalog.transaction() as tx:
        held = requests.begin(
            tx, key["Idempotency-Key"], asked, lease_seconds=lease_seconds, keep_seconds=3600.0, most=MOST_KEYS
        )  # fmt: skip
    return replace(held, kinds=frozenset({"uploads", "api_keys"}))


def kept(service, key: dict) -> RequestRow | None:
    """What the catalog holds of a request."""
    with service.catalog.reading() as session:
        return session.get(RequestRow, (DEFAULT_PROJECT, key["Idempotency-Key"]))


def without_urls(upload: dict) -> dict:
    return upload | {"parts": [part | {"url": None} for part in upload["parts"]]}


def test_the_same_request_again_is_answered_alike_and_not_done_again(service, key, upload):
    first, again = (post(service, "/v1/uploads", upload, key) for _ in range(2))
    assert first.status_code == again.status_code == 201
    assert without_urls(first.json()) == without_urls(again.json())
    assert first.headers["location"] == again.headers["location"]
    assert again.headers["idempotent-replay"] == "true"
    assert "idempotent-replay" not in first.headers
    assert len(made(service, upload)) == 1


def test_without_a_key_every_request_counts(service, upload):
    first, again = (post(service, "/v1/uploads", upload, {}) for _ in range(2))
    assert first.json()["id"] != again.json()["id"]


def test_a_key_belongs_to_its_request(service, key, upload):
    assert post(service, "/v1/uploads", upload, key).is_success
    other = post(service, "/v1/uploads", upload | {"size": 10}, key)
    assert service.refused(other, 422, "idempotency-key-reused")["errors"][0]["where"] == "Idempotency-Key"
    service.refused(post(service, "/v1/jobs", upload, key), 422, "idempotency-key-reused")
    assert len(made(service, upload)) == 1


def test_a_key_belongs_to_its_project(service, key, upload):
    project = service.http.post("/v1/projects", json={"name": secrets.token_hex(8)}).json()["id"]
    first = post(service, "/v1/uploads", upload, key)
    elsewhere = post(service, "/v1/uploads", upload, key | {"L3PS-Project": project})
    assert elsewhere.status_code == 201 and elsewhere.json()["id"] != first.json()["id"]


def test_of_many_at_once_exactly_one_has_an_effect(service, key, upload):
    with ThreadPoolExecutor(12) as pool:
        answers = list(pool.map(lambda _: post(service, "/v1/uploads", upload, key), range(24)))
    assert {answer.status_code for answer in answers} <= {201, 409}
    ids = {answer.json()["id"] for answer in answers if answer.status_code == 201}
    assert [row.id for row in made(service, upload)] == list(ids)
    for answer in answers:
        if answer.status_code == 409:
            service.refused(answer, 409, "request-in-progress")
            assert int(answer.headers["retry-after"]) >= 1


def test_while_the_first_is_in_progress_the_second_is_told_to_wait(service, key, upload):
    begun(service, "/v1/uploads", upload, key, lease_seconds=60)
    answer = post(service, "/v1/uploads", upload, key)
    service.refused(answer, 409, "request-in-progress")
    assert int(answer.headers["retry-after"]) >= 1
    assert made(service, upload) == []


def test_a_request_whose_process_died_before_its_effect_is_done_by_the_next(service, key, upload):
    begun(service, "/v1/uploads", upload, key, lease_seconds=0)
    assert post(service, "/v1/uploads", upload, key).status_code == 201
    assert len(made(service, upload)) == 1


def test_an_upload_whose_process_died_after_its_commit_is_answered_with_that_upload(service, key, upload):
    held = begun(service, "/v1/uploads", upload, key, lease_seconds=0)
    place = f"uploads/{secrets.token_hex(8)}/log.tar"
    multipart = service.store.create_multipart(place, 5 << 20)
    with requests.bound(held), service.catalog.transaction() as tx:
        # The setting was another one when it was opened: its parts keep their size.
        file = {"parts": 1, "part_size": 7 << 20, "object_key": place, "s3_upload_id": multipart}
        row = uploads.add(tx, **upload, **file, seconds=3600)
    answer = post(service, "/v1/uploads", upload, key)
    assert answer.status_code == 201
    assert answer.json()["part_size"] == 7 << 20
    assert answer.json()["id"] == row.id
    assert answer.headers["location"] == f"/v1/uploads/{row.id}"
    assert httpx.put(answer.json()["parts"][0]["url"], content=b"123456789").is_success
    assert len(made(service, upload)) == 1
    again = post(service, "/v1/uploads", upload, key)
    assert without_urls(again.json()) == without_urls(answer.json()) and again.headers["idempotent-replay"] == "true"


def test_any_other_resource_is_answered_as_it_is_now(service, key):
    body = {"name": secrets.token_hex(8)}
    held = begun(service, "/v1/projects", body, key, lease_seconds=0)
    with requests.bound(held), service.catalog.transaction() as tx:
        row = projects.add(tx, body["name"])
        requests.note_result(tx.session, "projects", row.id)
    answer = post(service, "/v1/projects", body, key)
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/v1/projects/{row.id}"
    assert answer.json()["id"] == row.id


def test_a_key_whose_secret_nobody_saw_gets_another(service, key):
    body = {"name": "lost", "scope": "read"}
    held = begun(service, "/v1/keys", body, key, lease_seconds=0)
    with requests.bound(held), service.catalog.transaction() as tx:
        row = keys.add(tx, id=new_id("key"), name="lost", scope="read", secret_sha256="0" * 64, expires_at=None)
    answer = post(service, "/v1/keys", body, key)
    assert answer.status_code == 201 and answer.json()["id"] == row.id
    credentials = {"Authorization": f"Bearer {answer.json()['secret']}"}
    assert httpx.get(f"{service.url}/v1/me", headers=credentials).json()["key"]["id"] == row.id


def test_a_secret_is_shown_once_and_not_kept_with_the_answer(service, key):
    first, again = (post(service, "/v1/keys", {"name": "once", "scope": "read"}, key) for _ in range(2))
    secret = first.json()["secret"]
    assert secret
    assert again.json() == first.json() | {"secret": None}
    body = kept(service, key).body
    assert secret.encode() not in body and json.loads(body)["id"] == first.json()["id"]


def test_the_secret_of_a_webhook_is_shown_again_and_not_kept_with_the_answer(service, key):
    first, again = (post(service, "/v1/webhooks", {"url": "http://127.0.0.1:9/"}, key) for _ in range(2))
    assert first.status_code == 201 and first.json()["secret"].startswith("whsec_")
    assert again.json() == first.json() and again.headers["idempotent-replay"] == "true"
    assert kept(service, key).body is None
    service.http.delete(first.headers["location"])


def test_signed_urls_are_made_anew_and_never_kept(service, key, upload):
    opened = post(service, "/v1/uploads", upload, key)
    assert kept(service, key).body is None
    put = httpx.put(post(service, "/v1/uploads", upload, key).json()["parts"][0]["url"], content=b"123456789")
    assert put.is_success, put.text
    fresh = {"Idempotency-Key": secrets.token_hex(16)}
    for _ in range(2):
        parts = post(service, f"{opened.headers['location']}/parts", {"numbers": [1]}, fresh)
        assert parts.status_code == 200 and parts.json()["parts"][0]["url"]
        assert kept(service, fresh) is None, "it changed nothing: asked again, it is done again"


def test_another_caller_is_not_answered_what_the_first_was(service, key):
    """Else an API key would be told what the operator was, or the operator that an API key may not."""
    secret = service.http.post("/v1/keys", json={"name": "x", "scope": "admin"}).json()["secret"]
    theirs = key | {"Authorization": f"Bearer {secret}"}
    body = {"name": secrets.token_hex(8)}
    service.refused(post(service, "/v1/projects", body, theirs), 403, "forbidden")
    assert post(service, "/v1/projects", body, key).status_code == 201
    service.refused(post(service, "/v1/projects", body, theirs), 403, "forbidden")
    upload = {"kind": "drive", "filename": "a.tar", "size": 9}
    shared = {"Idempotency-Key": secrets.token_hex(16)}
    assert post(service, "/v1/uploads", upload, shared).status_code == 201
    answer = post(service, "/v1/uploads", upload, theirs | shared)
    assert "caller" in service.refused(answer, 422, "idempotency-key-reused")["errors"][0]["what"]


def test_a_refusal_is_an_answer_too(service, key):
    body = {"drive_id": new_id("drv"), "model": "none"}
    first, again = (post(service, "/v1/jobs", body, key) for _ in range(2))
    service.refused(first, 404, "unknown-drive")
    assert again.content == first.content
    assert again.headers["idempotent-replay"] == "true"
    assert again.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("values", [[b""], [b"x" * 256], ["schlüssel".encode()], [b"one", b"another"]])
def test_a_key_is_short_and_printable_and_there_is_one(service, upload, values):
    answer = post(service, "/v1/uploads", upload, [(b"idempotency-key", value) for value in values])
    assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "Idempotency-Key"
    assert made(service, upload) == []
