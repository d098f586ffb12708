"""What a connection may cost before there is a request."""

import asyncio
import socket
import threading
from collections.abc import Iterator

import httpx
import pytest
import uvicorn
from starlette.requests import Request
from starlette.responses import PlainTextResponse

from l3ps_api.middleware import HEADER_BYTES, SizeLimits
from l3ps_api.server import HEAD_BYTES, Protocol, most_connections


class Hasty(Protocol):
    HEADER_SECONDS = 0.2


async def echo(scope, receive, send) -> None:
    body = await Request(scope, receive).body()
    await PlainTextResponse(body)(scope, receive, send)


@pytest.fixture
def address() -> Iterator[tuple[str, int]]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        app = SizeLimits(echo, exempt="/none")
        config = uvicorn.Config(
            app, http=Hasty, log_config=None, lifespan="off", h11_max_incomplete_event_size=HEAD_BYTES
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(server.serve([listening])))
        thread.start()
        yield listening.getsockname()
        server.should_exit = True
        thread.join()


@pytest.mark.parametrize("begun", [b"", b"GET / HTTP/1.1\r\nHost: x\r\nX-", b"G"])
def test_a_client_that_does_not_come_to_the_end_of_its_headers_is_hung_up_on(address, begun):
    with socket.create_connection(address, timeout=30) as connection:
        connection.sendall(begun)
        with pytest.raises(ConnectionResetError):
            connection.recv(1) or _closed()


def test_a_second_request_has_no_more_time_than_the_first(address):
    with socket.create_connection(address, timeout=30) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert connection.recv(1000).startswith(b"HTTP/1.1 200")
        connection.sendall(b"GET / HTTP/1.1\r\n")
        with pytest.raises(ConnectionResetError):
            connection.recv(1) or _closed()


def test_a_body_has_all_the_time_it_takes(address):
    late = threading.Event()

    def body():
        yield b"a"
        late.wait(3 * Hasty.HEADER_SECONDS)
        yield b"b"

    assert httpx.post("http://{}:{}/".format(*address), content=body()).text == "ab"


def test_headers_that_are_too_large_are_refused(address):
    url = "http://{}:{}/".format(*address)
    answer = httpx.get(url, headers={f"x-{n}": "x" * 1000 for n in range(HEADER_BYTES // 1000 + 1)})
    assert answer.status_code == 431 and answer.json()["errors"][0]["where"] == "headers"
    assert httpx.get(url, headers={"x": "x" * 1000}).is_success


def test_a_process_takes_as_many_connections_as_it_can_open_files_for():
    assert 0 < most_connections() < 1 << 16


def _closed() -> None:
    raise ConnectionResetError
