"""ETags: no byte twice, and no change to a document that one has not seen."""

import secrets

import pytest


@pytest.fixture
def upload(service) -> str:
    return f"/v1/uploads/{service.announce(9)['id']}"


@pytest.fixture
def key(service) -> str:
    made = service.http.post("/v1/keys", json={"name": secrets.token_hex(4), "scope": "read"})
    return made.headers["location"]


def test_what_the_client_has_is_not_sent_again(service, upload):
    first = service.http.get(upload)
    assert first.headers["etag"].startswith('"')
    for given in (first.headers["etag"], f'"other", {first.headers["etag"]}', f"W/{first.headers['etag']}", "*"):
        again = service.http.get(upload, headers={"If-None-Match": given})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == first.headers["etag"]
    assert service.http.get(upload, headers={"If-None-Match": '"other"'}).content == first.content


def test_a_change_changes_the_etag(service, upload):
    before = service.http.get(upload).headers["etag"]
    service.http.delete(upload)
    after = service.http.get(upload, headers={"If-None-Match": before})
    assert after.status_code == 200 and after.headers["etag"] != before


def test_every_document_has_one(service):
    documents = service.http.get("/openapi.json").json()["paths"]
    asked = 0
    for path, operations in documents.items():
        described = operations.get("get", {})
        plain = "application/json" in described.get("responses", {}).get("200", {}).get("content", {})
        if plain and path.startswith("/v1/") and "{" not in path:
            answer = service.http.get(path)
            if answer.status_code == 200:
                asked += 1
                etag = answer.headers["etag"]
                assert service.http.get(path, headers={"If-None-Match": etag}).status_code in (200, 304), path
    assert asked >= 6


def test_a_document_that_has_changed_since_is_not_deleted(service, key):
    seen = service.http.get(key).headers["etag"]
    service.http.post(f"{key}/rotate", json={"overlap_seconds": 60})
    refused = service.refused(service.http.delete(key, headers={"If-Match": seen}), 412, "changed")
    assert refused["errors"][0]["where"] == "If-Match"
    now = service.http.get(key)
    assert now.json()["revoked_at"] is None
    assert service.http.delete(key, headers={"If-Match": now.headers["etag"]}).status_code == 204
    assert service.http.get(key).json()["revoked_at"] is not None


def test_a_weak_etag_is_not_enough_for_a_change_and_a_star_is(service, key):
    seen = service.http.get(key).headers["etag"]
    service.refused(service.http.delete(key, headers={"If-Match": f"W/{seen}"}), 412, "changed")
    assert service.http.delete(key, headers={"If-Match": "*"}).status_code == 204


def test_what_does_not_exist_is_said_before_any_etag(service):
    service.refused(service.http.delete("/v1/drives/none", headers={"If-Match": '"x"'}), 404, "unknown-drive")
