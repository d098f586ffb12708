"""Webhooks from end to end: a real API calls real receivers on the loopback interface."""

import threading
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler

import pytest
from tests.contract.api.receivers import Receiver, status


def test_a_test_message_arrives_signed_and_is_logged(receiver, hooked, ping, delivered):
    hook = hooked(receiver.url)
    id = ping(hook)
    got = receiver.next()
    assert got.id == id and got.signed_with(hook["secret"]) and len(got.signatures) == 1
    assert got.document["type"] == "ping" and got.document["data"]["id"] == hook["id"]
    assert abs(datetime.now(UTC).timestamp() - got.timestamp) < 300
    row = delivered(hook, id)
    assert (row["state"], row["attempts"], row["last_status"], row["seq"]) == ("delivered", 1, 200, None)
    assert row["body"].encode() == got.body
    ((attempt,),) = [row["log"]]
    assert (attempt["status"], attempt["error"]) == (200, None)


def test_what_happens_is_told_to_those_who_asked(service, receiver, hooked, played):
    hook = hooked(receiver.url, "job.succeeded", "scene.*")
    job = played(scenes=1)
    job.finish()
    got = sorted((receiver.next() for _ in range(2)), key=lambda each: each.document["type"])
    assert [each.document["type"] for each in got] == ["job.succeeded", "scene.done"]
    assert got[0].document["data"]["id"] == job.id and got[1].document["data"]["job_id"] == job.id
    assert all(each.signed_with(hook["secret"]) for each in got)
    page = service.http.get(f"/v1/webhooks/{hook['id']}/deliveries", params={"limit": 1}).json()
    (newest,) = page["items"]
    rest = service.http.get(f"/v1/webhooks/{hook['id']}/deliveries", params={"cursor": page["next"]}).json()
    assert [newest["type"], *(row["type"] for row in rest["items"])] == ["job.succeeded", "scene.done"]
    assert rest.get("next") is None and newest["seq"] > rest["items"][0]["seq"]


@pytest.mark.once
def test_a_failed_delivery_is_tried_again_under_the_same_id(receiver, hooked, ping, delivered):
    receiver.answer(status(500), status(302, Location="/elsewhere"))
    hook = hooked(receiver.url)
    id = ping(hook)
    assert {receiver.next().id for _ in range(3)} == {id}
    row = delivered(hook, id)
    assert (row["state"], row["attempts"]) == ("delivered", 3)
    assert [attempt["status"] for attempt in row["log"]] == [500, 302, 200]
    assert "redirects are not followed" in row["log"][1]["error"]


@pytest.mark.once
def test_a_delivery_fails_in_the_end_and_can_be_replayed(service, receiver, hooked, ping, delivered):
    receiver.answer(*[status(500)] * 3, *[status(503)] * 3)
    hook = hooked(receiver.url)
    before = datetime.now(UTC) - timedelta(minutes=1)
    one = ping(hook)
    assert delivered(hook, one)["state"] == "failed"
    two = ping(hook)
    assert delivered(hook, two)["attempts"] == 3
    assert service.http.get(f"/v1/webhooks/{hook['id']}").json()["failing_since"] is not None

    path = f"/v1/webhooks/{hook['id']}/deliveries"
    failed = service.http.get(path, params={"state": "failed"}).json()["items"]
    assert {row["id"] for row in failed} == {one, two}
    answer = service.http.post(f"{path}/{one}/replay")
    assert (answer.status_code, answer.json()["state"]) == (202, "pending")
    assert delivered(hook, one)["state"] == "delivered"
    answer = service.http.post(f"/v1/webhooks/{hook['id']}/replay", json={"since": before.isoformat()})
    assert (answer.status_code, answer.json()) == (202, {"count": 1})
    assert delivered(hook, two)["state"] == "delivered"
    assert service.http.get(f"/v1/webhooks/{hook['id']}").json()["failing_since"] is None
    received = [receiver.got.get_nowait().id for _ in range(8)]
    assert (received.count(one), received.count(two)) == (4, 4)


def test_410_switches_a_webhook_off_until_it_is_switched_on(service, receiver, hooked, ping, delivered):
    watcher = Receiver()
    hooked(watcher.url, "webhook.disabled")
    receiver.answer(status(410))
    hook = hooked(receiver.url)
    id = ping(hook)
    assert delivered(hook, id)["attempts"] == 1
    reason = "the receiver answered 410: it wants no more messages"
    assert watcher.next().document["data"] == {"id": hook["id"], "reason": reason}, "a URL may be a secret"
    watcher.close()
    shown = service.http.get(f"/v1/webhooks/{hook['id']}").json()
    assert not shown["enabled"] and "410" in shown["disabled_reason"]
    service.refused(service.http.post(f"/v1/webhooks/{hook['id']}/test"), 409, "conflict")
    service.refused(service.http.post(f"/v1/webhooks/{hook['id']}/deliveries/{id}/replay"), 409, "conflict")
    shown = service.http.patch(f"/v1/webhooks/{hook['id']}", json={"enabled": True}).json()
    assert shown["enabled"] and shown["disabled_reason"] is None
    assert delivered(hook, ping(hook))["state"] == "delivered"


@pytest.mark.once
def test_a_receiver_that_asks_for_time_gets_it(receiver, hooked, ping, delivered):
    receiver.answer(status(429, Retry_After="3600"))
    hook = hooked(receiver.url)
    row = delivered(hook, ping(hook), until=lambda row: row["attempts"] == 1)
    wait = datetime.fromisoformat(row["next_at"]) - datetime.fromisoformat(row["created_at"])
    assert row["state"] == "pending" and wait > timedelta(minutes=59)


@pytest.mark.once
def test_a_receiver_that_hangs_holds_nobody_up_and_is_given_up_on(receiver, hooked, ping, delivered):
    """One never answers, one sends a byte now and then, one answers without end; all the while others are served."""
    release = threading.Event()

    def hang(handler: BaseHTTPRequestHandler) -> None:
        release.wait(30)

    def drip(handler: BaseHTTPRequestHandler) -> None:
        handler.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n")
        while not release.wait(0.2):
            handler.wfile.write(b".")

    def flood(handler: BaseHTTPRequestHandler) -> None:
        handler.wfile.write(b"HTTP/1.1 200 OK\r\n\r\n")
        while not release.is_set():
            handler.wfile.write(b"." * (1 << 20))

    slow, endless = Receiver(), Receiver()
    try:
        slow.answer(hang, drip)
        endless.answer(flood)
        stuck, flooded, quick = hooked(slow.url), hooked(endless.url), hooked(receiver.url)
        ids = [ping(hook) for hook in (stuck, flooded, quick)]
        assert delivered(quick, ids[2])["state"] == "delivered"
        assert delivered(flooded, ids[1])["state"] == "delivered", "the status is known; what follows is not read"
        row = delivered(stuck, ids[0])
    finally:
        release.set()
        slow.close()
        endless.close()
    assert [attempt["error"] for attempt in row["log"]] == ["no complete answer within 3 s"] * 2 + [None]
