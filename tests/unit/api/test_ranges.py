"""A body of known length over ASGI: what is read of it, and when reading ends."""

import asyncio
from types import SimpleNamespace

import pytest

from l3ps_api.objects import service as objects
from l3ps_api.ranges import RangedResponse, byte_range
from l3ps_platform.errors import StoreUnavailable
from l3ps_platform.objects import DirectoryStore
from l3ps_platform.objects.signing import Grant

BLOCKS, BLOCK = 1000, 1 << 16


class Source:
    """A long body that notes what is read of it, and fails where it is told to."""

    def __init__(self, fails_at: int = BLOCKS) -> None:
        self.read_blocks, self.closed, self.fails_at = 0, False, fails_at

    def read(self, begin: int, end: int):
        try:
            for number in range(begin // BLOCK, -(-end // BLOCK)):
                if number == self.fails_at:
                    raise StoreUnavailable("the store is away")
                self.read_blocks += 1
                yield bytes(BLOCK)
        finally:
            self.closed = True


def answered(source: Source, *, taken: int = BLOCKS, version: str = "2.3", **headers: str) -> list[dict]:
    """What a server gets to send to a client that is gone after so many blocks."""
    sent: list[dict] = []
    gone = asyncio.Event()

    async def receive() -> dict:
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict) -> None:
        if gone.is_set() and version == "2.4":
            raise OSError("nobody there")
        sent.append(message)
        if len(sent) > taken:
            gone.set()
            await asyncio.sleep(0)

    async def run() -> None:
        response = RangedResponse(source.read, BLOCKS * BLOCK, "tag", "application/x-tar", {})
        given = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "method": "GET", "path": "/x", "headers": given, "asgi": {"spec_version": version}}
        await response(scope, receive, send)

    asyncio.run(run())
    return sent


def test_all_of_it_comes_in_order() -> None:
    sent = answered(source := Source())
    assert sum(len(message.get("body", b"")) for message in sent) == BLOCKS * BLOCK
    assert source.closed


@pytest.mark.parametrize("version", ["2.3", "2.4"])
def test_nothing_more_is_read_for_a_client_that_is_gone(version: str) -> None:
    source = Source()
    try:
        answered(source, taken=5, version=version)
    except Exception as error:
        assert version == "2.4" and type(error).__name__ == "ClientDisconnect"
    assert source.closed and source.read_blocks < 20


def test_what_lies_before_a_range_is_not_read() -> None:
    source = Source()
    sent = answered(source, range=f"bytes={(BLOCKS - 2) * BLOCK}-")
    assert sent[0]["status"] == 206 and source.read_blocks == 2


def test_a_source_that_fails_ends_the_answer_unfinished() -> None:
    """The server then cuts the connection; only a last message without ``more_body`` would say that this was all."""
    source = Source(fails_at=3)
    with pytest.raises(StoreUnavailable):
        answered(source)
    assert source.closed


@pytest.mark.parametrize("headers", [{}, {"range": "bytes=3-5"}, {"if-none-match": "*"}, {"range": "bytes=99-"}])
def test_an_object_is_sent_as_it_was_when_its_answer_began(tmp_path, headers) -> None:
    """Another may take its name in between: then neither length nor bytes may be the new one's."""
    store = DirectoryStore(tmp_path, "http://here")
    store.put_bytes("a/b.bin", b"old bytes")
    response = objects.send(SimpleNamespace(store=store), Grant("GET", "a/b.bin"))
    file = response._close.__self__
    store.put_bytes("a/b.bin", b"and newer ones")
    sent: list[dict] = []

    async def send(message: dict) -> None:
        sent.append(message)

    given = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": "GET", "path": "/x", "headers": given, "asgi": {"spec_version": "2.4"}}
    asyncio.run(response(scope, None, send))
    body = b"".join(message.get("body", b"") for message in sent)
    expected = {200: b"old bytes", 206: b" by", 304: b""}
    assert body == expected.get(sent[0]["status"], body)
    assert file.closed


@pytest.mark.parametrize(
    ("header", "found"),
    [
        ("bytes=0-", (0, 10)),
        ("bytes=3-5", (3, 6)),
        ("Bytes=3-99", (3, 10)),
        ("bytes=-4", (6, 10)),
        ("bytes=-99", (0, 10)),
        ("bytes=10-", (10, 10)),
        ("bytes=-0", (10, 10)),
        ("bytes=5-3", None),
        ("bytes=-", None),
        ("bytes=1-2,4-5", None),
        ("lines=1-2", None),
        ("bytes=x-", None),
        ("", None),
        ("bytes=" + "9" * 30 + "-", None),
    ],
)
def test_ranges_as_clients_write_them(header: str, found: tuple[int, int] | None) -> None:
    assert byte_range(header, 10) == found
