"""An answer whose reader takes nothing, on the real server: its connection does not stay."""

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Iterator

import pytest
import uvicorn
from starlette.responses import Response

from l3ps_api.events.stream import EventStream
from l3ps_api.ranges import RangedResponse
from l3ps_api.server import Protocol

MiB = 1 << 20


class Hasty(Protocol):
    SEND_SECONDS = 0.2


def endless(begin: int, end: int) -> Iterator[bytes]:
    while begin < end:
        begin += MiB
        yield bytes(MiB)


async def events() -> AsyncIterator[bytes]:
    while True:
        yield bytes(1 << 16)
        await asyncio.sleep(0)


ANSWERS = {
    "download": lambda: RangedResponse(endless, 1 << 40, "tag", "application/x-tar", {}),
    "events": lambda: EventStream(events()),
    "document": lambda: Response(bytes(32 * MiB)),
    "last bytes": lambda: Response(bytes(4 * MiB), headers={"connection": "close"}),
}


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_a_reader_that_takes_nothing_is_hung_up_on_and_leaves_no_connection(answer, caplog) -> None:
    ended = threading.Event()

    async def app(scope, receive, send) -> None:
        await answer()(scope, receive, send)
        ended.set()

    async def play(reader: socket.socket, server: uvicorn.Server) -> None:
        reader.sendall(b"GET /x HTTP/1.1\r\nHost: x\r\n\r\n")
        assert await asyncio.to_thread(ended.wait, 30)
        async with asyncio.timeout(30):
            while server.server_state.connections:
                await asyncio.sleep(0.01)

    _serve(app, play)
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def _serve(app, play) -> None:
    async def serve() -> None:
        config = uvicorn.Config(app, port=0, http=Hasty, lifespan="off", log_config=None, access_log=False)
        server = uvicorn.Server(config)
        serving = asyncio.create_task(server.serve())
        while not server.started:
            await asyncio.sleep(0.01)
        with socket.create_connection(("127.0.0.1", server.servers[0].sockets[0].getsockname()[1])) as reader:
            await play(reader, server)
        server.should_exit = True
        await serving

    asyncio.run(serve())
