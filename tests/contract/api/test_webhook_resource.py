"""Webhooks are made, shown, changed and deleted."""

import json

import pytest


def test_a_rotated_secret_overlaps_with_the_old_one(service, receiver, hooked, ping):
    hook = hooked(receiver.url)
    path = f"/v1/webhooks/{hook['id']}/rotate"
    second = service.http.post(path, json={"overlap_seconds": 600}).json()
    assert second["secret"] != hook["secret"] and second["previous_secret_until"]
    ping(hook)
    got = receiver.next()
    assert len(got.signatures) == 2 and got.signed_with(hook["secret"]) and got.signed_with(second["secret"])
    third = service.http.post(path, json={"overlap_seconds": 0}).json()
    ping(hook)
    got = receiver.next()
    assert len(got.signatures) == 1 and got.signed_with(third["secret"]) and not got.signed_with(second["secret"])


def test_secrets_are_shown_once(service, receiver, hooked):
    hook = hooked(receiver.url)
    for answer in (
        service.http.get("/v1/webhooks"),
        service.http.get(f"/v1/webhooks/{hook['id']}"),
        service.http.patch(f"/v1/webhooks/{hook['id']}", json={"description": "of the tests"}),
    ):
        assert answer.is_success and "whsec_" not in answer.text and hook["id"] in answer.text


def test_webhooks_are_listed_changed_and_deleted(service, receiver, hooked, played):
    hook, other = hooked(receiver.url), hooked(receiver.url)
    page = service.http.get("/v1/webhooks", params={"limit": 1}).json()
    assert [item["id"] for item in page["items"]] == [other["id"]] and page["next"]
    changed = service.http.patch(
        f"/v1/webhooks/{hook['id']}", json={"events": ["job.cancelled"], "enabled": False}
    ).json()
    assert (changed["events"], changed["enabled"], changed["disabled_reason"]) == (
        ["job.cancelled"],
        False,
        "on request",
    )
    assert changed["url"] == receiver.url
    played().cancel()
    assert service.http.get(f"/v1/webhooks/{hook['id']}/deliveries").json()["items"] == []
    assert service.http.delete(f"/v1/webhooks/{hook['id']}").status_code == 204
    for answer in (
        service.http.get(f"/v1/webhooks/{hook['id']}"),
        service.http.patch(f"/v1/webhooks/{hook['id']}", json={}),
        service.http.delete(f"/v1/webhooks/{hook['id']}"),
        service.http.post(f"/v1/webhooks/{hook['id']}/test"),
        service.http.post(f"/v1/webhooks/{hook['id']}/rotate"),
        service.http.get(f"/v1/webhooks/{hook['id']}/deliveries"),
    ):
        service.refused(answer, 404, "unknown-webhook")
    service.refused(
        service.http.post(f"/v1/webhooks/{other['id']}/deliveries/msg_none/replay"), 404, "unknown-delivery"
    )


def test_bad_requests_name_field_and_remedy(service, receiver):
    for body, where in [
        ({"url": receiver.url, "events": ["job.done"]}, "events.0"),
        ({"url": "ftp://example.com/"}, "url"),
        ({"url": "https://user:password@example.com/"}, "url"),
        ({"url": receiver.url, "secret": "mine"}, "secret"),
        ({}, "url"),
    ]:
        answer = service.http.post("/v1/webhooks", json=body)
        assert answer.status_code == 422
        (error,) = answer.json()["errors"]
        assert error["where"] == where and error["remedy"]
        assert "password" not in answer.text


@pytest.mark.once
def test_characters_that_no_database_keeps_are_refused(service, receiver):
    for text in ("\0", "\ud800"):
        body = json.dumps({"url": receiver.url, "description": text})
        answer = service.http.post("/v1/webhooks", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 422, answer.text
        body = json.dumps({"url": f"{receiver.url}{text}"})
        answer = service.http.post("/v1/webhooks", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 422, answer.text
    for path in ("/v1/webhooks/%00", "/v1/webhooks/%00/deliveries", "/v1/jobs/%00/events", "/v1/events?subject=%00"):
        assert service.http.get(path).status_code in (404, 422), path
