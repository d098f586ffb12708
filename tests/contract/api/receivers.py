"""Receivers of webhooks on the loopback interface, and webhooks that lead to them."""

import base64
import hashlib
import hmac
import json
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

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
