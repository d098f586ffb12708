"""One attempt at a delivery, over real sockets: it goes to the address that was looked at and nowhere else."""

import asyncio
import http.server
import socket
import ssl
import threading
from collections.abc import Iterator
from ipaddress import ip_network
from pathlib import Path

import pytest

from l3ps_platform.webhooks import Guard, sending
from l3ps_platform.webhooks.sending import Answer

# Made for these tests, for no other name: openssl req -x509 -newkey ec … -addext subjectAltName=DNS:hooks.example
PEM = Path(__file__).parent / "tls" / "hooks.example.pem"


class Names:
    """A name server whose answers change from one question to the next, as an attacker's do."""

    def __init__(self, *answers: str) -> None:
        self.answers = [answer.split() for answer in answers]
        self.asked: list[str] = []

    def __call__(self, host: str, port: int) -> list[str]:
        self.asked.append(host)
        return self.answers[min(len(self.asked), len(self.answers)) - 1]


def send(url: str, names: Names, allow: str = "127.0.0.1/32") -> Answer:
    guard = Guard([ip_network(allow)], http=True, resolver=names)
    return asyncio.run(sending.attempt(guard, url, ["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"], "msg_1", b"{}", 5))


class Receiver:
    """Takes everything; with TLS it shows its certificate and notes the name that it was asked for."""

    def __init__(self, *, tls: bool) -> None:
        self.hosts: list[str] = []
        self.names: list[str | None] = []
        receiver = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                receiver.hosts.append(self.headers["host"])
                self.rfile.read(int(self.headers["content-length"]))
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        class Server(http.server.ThreadingHTTPServer):
            def handle_error(self, *_: object) -> None:
                pass  # a client that does not like the certificate

        self.server = Server(("127.0.0.1", 0), Handler)
        if tls:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(PEM)
            context.sni_callback = lambda _socket, name, _context: self.names.append(name)
            self.server.socket = context.wrap_socket(
                self.server.socket, server_side=True, do_handshake_on_connect=False
            )
        self.port = self.server.server_address[1]
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05})
        self.thread.start()

    def close(self) -> None:
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


@pytest.fixture(params=["http", "https"])
def receiver(request, monkeypatch) -> Iterator[Receiver]:
    made = Receiver(tls=request.param == "https")
    made.scheme = request.param
    trusting = ssl.create_default_context(cafile=PEM)
    monkeypatch.setattr(sending, "_tls", lambda: trusting)
    yield made
    made.close()


def test_the_receiver_is_called_by_its_name_at_the_address_that_was_looked_at(receiver) -> None:
    names = Names("127.0.0.1", "127.0.0.2")
    answer = send(f"{receiver.scheme}://hooks.example:{receiver.port}/x", names)
    assert (answer.status, answer.error) == (204, None)
    assert receiver.hosts == [f"hooks.example:{receiver.port}"]
    assert names.asked == ["hooks.example"], "a second question could have another answer"
    assert receiver.names == (["hooks.example"] if receiver.scheme == "https" else [])


def test_a_certificate_of_another_name_is_not_taken(receiver) -> None:
    answer = send(f"https://other.example:{receiver.port}/x", Names("127.0.0.1"))
    assert answer.status is None and "ConnectError" in answer.error
    assert receiver.hosts == []


def test_one_forbidden_address_beside_an_allowed_one_forbids_the_name(receiver) -> None:
    answer = send(f"{receiver.scheme}://hooks.example:{receiver.port}/x", Names("127.0.0.1 127.0.0.2"))
    assert answer.error == "not sent: 'hooks.example' is no public address and no name of one"
    assert receiver.hosts == []


def test_another_address_is_tried_where_one_does_not_answer(receiver) -> None:
    names = Names("127.0.0.3 127.0.0.1")
    answer = send(f"{receiver.scheme}://hooks.example:{receiver.port}/x", names, allow="127.0.0.0/8")
    assert answer.status == 204
    closed = send(f"{receiver.scheme}://hooks.example:{receiver.port}/x", Names("127.0.0.3"), allow="127.0.0.0/8")
    assert closed.status is None and "ConnectError" in closed.error


def test_what_nobody_foresaw_counts_as_an_attempt() -> None:
    """What is not counted would be made again for ever."""

    def broken(host: str, port: int) -> list[str]:
        raise ZeroDivisionError

    assert send("https://hooks.example/x", broken).error == "not sent: the service failed (ZeroDivisionError)"
    guard = Guard(resolver=Names("1.1.1.1"))
    answer = asyncio.run(sending.attempt(guard, "https://hooks.example/x", ["no secret"], "msg_1", b"{}", 5))
    assert answer.error is not None and answer.error.startswith("not sent: the service failed")


def test_proxies_of_the_environment_are_not_used(receiver, monkeypatch) -> None:
    with socket.socket() as proxy:
        proxy.bind(("127.0.0.1", 0))
        proxy.listen()
        for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy", "all_proxy"):
            monkeypatch.setenv(name, f"http://127.0.0.1:{proxy.getsockname()[1]}")
        assert send(f"{receiver.scheme}://hooks.example:{receiver.port}/x", Names("127.0.0.1")).status == 204
        proxy.setblocking(False)
        with pytest.raises(BlockingIOError):
            proxy.accept()
