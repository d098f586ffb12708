"""Webhooks from end to end: a real API calls real receivers on the loopback interface."""

import base64
import hashlib
import hmac
import json
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from l3ps_platform.catalog import webhooks

Answer = Callable[[BaseHTTPRequestHandler], None]


@dataclass
class Got:
    """A message as a receiver gets it."""

    id: str
    timestamp: int
    signatures: list[str]
    body: bytes

    @property
    def document(self) -> dict:
        return json.loads(self.body)

    def signed_with(self, secret: str) -> bool:
        """Whether one of its signatures is this secret's, computed here from the specification."""
        key = base64.b64decode(secret.removeprefix("whsec_"))
        mac = hmac.new(key, f"{self.id}.{self.timestamp}.".encode() + self.body, hashlib.sha256).digest()
        return f"v1,{base64.b64encode(mac).decode()}" in self.signatures


class Receiver:
    """A receiver of webhooks: gives the answers that were prepared, then 200 for ever."""

    def __init__(self, address: str = "127.0.0.1") -> None:
        self.got: queue.Queue[Got] = queue.Queue()
        self.answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.got.put(
                    Got(
                        self.headers["webhook-id"],
                        int(self.headers["webhook-timestamp"]),
                        self.headers["webhook-signature"].split(),
                        body,
                    )
                )
                try:
                    answer = receiver.answers.get_nowait()
                except queue.Empty:
                    answer = status(200)
                with suppress(OSError):  # the other side has hung up
                    answer(self)

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer((address, 0), Handler)
        self.server.daemon_threads = True
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05})
        self.thread.start()

    @property
    def url(self) -> str:
        host, port = self.server.server_address[:2]
        return f"http://{host}:{port}/hook"

    def answer(self, *answers: Answer) -> None:
        for each in answers:
            self.answers.put(each)

    def next(self) -> Got:
        return self.got.get(timeout=30)

    def close(self) -> None:
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


def status(code: int, body: bytes = b"", **headers: str) -> Answer:
    def give(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(code)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.end_headers()
        handler.wfile.write(body)

    return give


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.close()


@pytest.fixture
def hooked(service) -> Iterator[Callable[..., dict]]:
    """Makes webhooks; deletes them in the end."""
    made = []

    def make(url: str, *kinds: str) -> dict:
        answer = service.http.post("/v1/webhooks", json={"url": url, "events": list(kinds) or ["webhook.disabled"]})
        assert answer.status_code == 201, answer.text
        assert answer.headers["location"] == f"/v1/webhooks/{answer.json()['id']}"
        made.append(answer.json()["id"])
        return answer.json()

    yield make
    for id in made:
        service.http.delete(f"/v1/webhooks/{id}")


@pytest.fixture
def ping(service) -> Callable[[dict], str]:
    """Sends a test message; the path of its delivery's log."""

    def send(hook: dict) -> str:
        answer = service.http.post(f"/v1/webhooks/{hook['id']}/test")
        assert answer.status_code == 202, answer.text
        return answer.json()["id"]

    return send


@pytest.fixture
def delivered(service) -> Callable[[dict, str], dict]:
    """A delivery's document once it is no longer pending."""

    def wait(hook: dict, id: str, until: Callable[[dict], bool] = lambda row: row["state"] != "pending") -> dict:
        def chosen(page: dict) -> dict:
            return next(row for row in page["items"] if row["id"] == id)

        return chosen(service.wait(f"/v1/webhooks/{hook['id']}/deliveries", lambda page: until(chosen(page)), 30))

    return wait


@contextmanager
def nobody_comes(address: str) -> Iterator[int]:
    """A port at which nobody may have knocked in the end."""
    with socket.socket() as listener:
        listener.bind((address, 0))
        listener.listen()
        yield listener.getsockname()[1]
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.accept()


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


def test_a_redirect_into_a_forbidden_network_is_not_followed(receiver, hooked, ping, delivered):
    with nobody_comes("127.0.0.2") as port:
        receiver.answer(*[status(code, Location=f"http://127.0.0.2:{port}/") for code in (302, 307, 308)])
        hook = hooked(receiver.url)
        row = delivered(hook, ping(hook))
        assert row["state"] == "failed"
        assert [attempt["status"] for attempt in row["log"]] == [302, 307, 308]


@pytest.mark.parametrize(
    "host", ["127.0.0.2", "2130706434", "0x7f000002", "0177.0.0.2", "127.2", "[::ffff:127.0.0.2]", "0.0.0.0", "[::1]"]
)
def test_a_forbidden_address_is_refused_however_it_is_written(service, host):
    with nobody_comes("127.0.0.2") as port:
        answer = service.http.post("/v1/webhooks", json={"url": f"http://{host}:{port}/hook"})
        (error,) = service.refused(answer, 422, "url-refused")["errors"]
        assert error["where"] == "url" and error["remedy"]


@pytest.mark.once
def test_an_address_that_has_become_forbidden_is_refused_at_the_delivery(service, receiver, hooked, ping, delivered):
    """As when a name comes to mean another address; here the row is changed behind the API's back."""
    hook = hooked(receiver.url)
    with nobody_comes("127.0.0.2") as port:
        with service.catalog.transaction() as tx:
            webhooks.lock(tx.session, hook["id"]).url = f"http://127.0.0.2:{port}/hook"
        row = delivered(hook, ping(hook))
    assert row["state"] == "failed"
    assert {attempt["error"] for attempt in row["log"]} == {
        "not sent: '127.0.0.2' is no public address and no name of one"
    }
    assert receiver.got.empty()


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
