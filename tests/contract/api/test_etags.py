"""ETags: no byte twice, and no change to a document that one has not seen."""

import secrets
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from l3ps_platform.catalog import Catalog
from l3ps_platform.objects import open_store


@pytest.fixture
def upload(service) -> str:
    return f"/v1/uploads/{service.announce(9)['id']}"


@pytest.fixture
def key(service) -> str:
    made = service.http.post("/v1/keys", json={"name": secrets.token_hex(4), "scope": "read"})
    return made.headers["location"]


@pytest.fixture
def webhook(service) -> Iterator[str]:
    path = service.http.post("/v1/webhooks", json={"url": "http://127.0.0.1:9/"}).headers["location"]
    yield path
    service.http.delete(path)


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


@pytest.mark.parametrize("path", ["/v1/events", "/v1/jobs/none/events", "/v1/labels.tar"])
def test_what_has_no_end_or_is_no_document_is_not_looked_at(service, path):
    service.refused(service.http.delete(path, headers={"If-Match": '"x"'}), 405, "method-not-allowed")
    assert service.http.get("/v1/me").is_success


def test_changes_with_a_condition_pass_among_as_many_others_as_come(service):
    """These wait for the lock or row of a change, and it asks once more what it changes before it ends."""

    def put(number: int) -> int:
        headers = {"If-Match": "*"} if number % 3 == 0 else {}
        limits = {"max_age_days": 36_000 + number if number else None, "max_bytes": None}
        return service.http.put("/v1/retention", json=limits, headers=headers).status_code

    with ThreadPoolExecutor(40) as pool:
        assert set(pool.map(put, range(1, 120))) == {200}
    assert put(0) == 200


def test_a_change_whose_body_dribbles_holds_nobody_up(service, webhook):
    begun, enough = threading.Event(), threading.Event()

    def body():
        yield b'{"descrip'
        begun.set()
        enough.wait()
        yield b'tion": "slow"}'

    headers = {"If-Match": "*", "Content-Type": "application/json"}
    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(service.http.patch, webhook, content=body(), headers=headers)
        begun.wait()
        try:
            assert service.http.patch(webhook, json={"description": "quick"}, headers=headers).is_success
        finally:
            enough.set()
        assert slow.result().json()["description"] == "slow"


def test_of_two_changes_to_what_both_have_seen_one_is_made_also_in_two_processes(service, webhook, replica):
    """The other process changes the document between this one's first look at it and its change."""
    seen = service.http.get(webhook).headers["etag"]
    others = []

    class Overtaken(Catalog):
        def transaction(self):
            if not others:
                others.append(service.http.patch(webhook, json={"description": "theirs"}, headers={"If-Match": seen}))
            return super().transaction()

    replica.app.state.services = replace(replica.app.state.services, catalog=Overtaken(service.settings.catalog_url))
    answer = replica.patch(webhook, json={"description": "mine"}, headers={"If-Match": seen})
    assert others[0].is_success
    service.refused(answer, 412, "changed")
    now = replica.get(webhook)
    assert now.json()["description"] == "theirs"
    answer = replica.patch(webhook, json={"description": "mine"}, headers={"If-Match": now.headers["etag"]})
    assert answer.json()["description"] == "mine"
    replica.app.state.services.catalog.dispose()


def test_what_cannot_be_looked_at_is_not_changed(service, upload, replica):
    """While the store is away nobody can say whether an upload is still as its client has seen it."""
    system = replica.app.state.services
    away = open_store(service.settings.model_copy(update={"objects_url": "s3://k:s@127.0.0.1:1/b?secure=0"}))
    replica.app.state.services = replace(system, store=away)
    service.refused(replica.delete(upload, headers={"If-Match": '"anything"'}), 503, "object-store-unavailable")
    assert service.http.get(upload).json()["state"] == "open"
