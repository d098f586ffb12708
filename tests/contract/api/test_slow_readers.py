"""A download whose reader takes nothing, on the real server: its connection does not stay."""

import asyncio
import socket
import threading
from collections.abc import Iterator

import uvicorn

from l3ps_api import patience
from l3ps_api.patience import HangUp
from l3ps_api.ranges import RangedResponse

MiB = 1 << 20


def endless(begin: int, end: int) -> Iterator[bytes]:
    while begin < end:
        begin += MiB
        yield bytes(MiB)


def test_a_reader_that_takes_nothing_is_hung_up_on_and_leaves_no_connection(monkeypatch, caplog) -> None:
    monkeypatch.setattr(patience, "SEND_SECONDS", 0.2)
    ended = threading.Event()

    async def app(scope, receive, send) -> None:
        assert scope["type"] == "http"
        await RangedResponse(endless, 1 << 40, "tag", "application/x-tar", {})(scope, receive, send)
        ended.set()

    async def play() -> None:
        server = uvicorn.Server(uvicorn.Config(HangUp(app), port=0, lifespan="off", log_config=None, access_log=False))
        serving = asyncio.create_task(server.serve())
        while not server.started:
            await asyncio.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as reader:
            reader.sendall(b"GET /x HTTP/1.1\r\nHost: x\r\n\r\n")
            assert await asyncio.to_thread(ended.wait, 30)
            async with asyncio.timeout(30):
                while server.server_state.connections:
                    await asyncio.sleep(0.01)
        server.should_exit = True
        await serving

    asyncio.run(play())
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
