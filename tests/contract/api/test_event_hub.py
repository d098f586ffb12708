"""One look at the catalog for all who listen, in this process: what streams cost, and what slow clients miss."""

import asyncio
import shutil
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from sqlalchemy import event

from l3ps_api.events import hub as hub_module
from l3ps_api.events import stream as stream_module
from l3ps_api.events.hub import Entry, EventHub
from l3ps_api.events.stream import Feed, told
from l3ps_platform.catalog import DEFAULT_PROJECT, Catalog, DriveState, drives, events
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.workflow import notices


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalog without rows, to be copied."""
    path = tmp_path_factory.mktemp("fresh") / "catalog.db"
    upgrade(f"sqlite:///{path}")
    return path


@pytest.fixture
def catalog(fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Catalog]:
    monkeypatch.setattr(hub_module, "TICK_SECONDS", 0.01)
    url = f"sqlite:///{shutil.copy(fresh, tmp_path)}"
    made = Catalog(url).scoped(DEFAULT_PROJECT)
    yield made
    made.dispose()


def happen(catalog: Catalog, count: int = 1) -> list[int]:
    """Make so many events; their numbers."""
    with catalog.transaction() as tx:
        before = events.last_seq(tx.session)
        for _ in range(count):
            drive = drives.add(tx, name="d", filename="d.zip", size=1, object_key=None)
            drive.state = DriveState.READY
            notices.of_upload(tx, drive)
    return list(range(before + 1, before + count + 1))


def feed(catalog: Catalog, cursor: int = 0, **fields) -> Feed:
    def read(seq: int) -> list[Entry]:
        with catalog.reading() as session:
            return [Entry.of(row) for row in events.after(session, seq, limit=hub_module.PAGE)]

    return Feed(cursor, read, lambda entry: True, **fields)


async def numbers(stream: AsyncIterator[bytes], count: int) -> list[int]:
    """The numbers of the next events of a stream."""
    found = []
    while len(found) < count:
        piece = (await anext(stream)).decode()
        found += [int(line[4:]) for line in piece.splitlines() if line.startswith("id: ")]
    return found


def test_the_catalog_is_looked_at_once_however_many_listen_and_not_at_all_when_nobody_does(catalog) -> None:
    looks = []

    @event.listens_for(catalog.engine, "before_cursor_execute")
    def count(_connection, _cursor, statement, *_rest) -> None:
        looks.append(statement)

    async def play() -> None:
        hub = EventHub(catalog)
        streams = [told(hub, feed(catalog)) for _ in range(50)]
        for stream in streams:
            await anext(stream)
        waiting = [asyncio.create_task(numbers(stream, 1)) for stream in streams]
        while hub.head < 0:
            await asyncio.sleep(0)
        quiet = len(looks)
        assert quiet <= 3, "to learn where the log ends; not one for each of the fifty"
        (seq,) = await asyncio.to_thread(happen, catalog)
        del looks[:]
        assert await asyncio.gather(*waiting) == [[seq]] * 50
        assert sum("FROM events" in statement for statement in looks) < 50
        for stream in streams:
            await stream.aclose()
        assert hub.listeners == 0
        del looks[:]
        await asyncio.sleep(5 * hub_module.TICK_SECONDS)
        assert looks == []
        late = told(hub, feed(catalog, seq))
        await anext(late)
        waiting = [asyncio.create_task(numbers(late, 1))]
        (seq,) = await asyncio.to_thread(happen, catalog)
        assert await asyncio.gather(*waiting) == [[seq]], "and again when somebody comes"
        await late.aclose()

    asyncio.run(play())


def test_a_client_that_falls_behind_the_ring_goes_on_from_the_log_and_misses_nothing(catalog, monkeypatch) -> None:
    monkeypatch.setattr(hub_module, "RING", 5)

    async def play() -> None:
        hub = EventHub(catalog)
        slow, quick = told(hub, feed(catalog)), told(hub, feed(catalog))
        for stream in (slow, quick):
            await anext(stream)
        reading = asyncio.create_task(numbers(quick, 40))
        starting = asyncio.create_task(numbers(slow, 1))
        expected = []
        for _ in range(20):
            expected += await asyncio.to_thread(happen, catalog, 2)
        assert await reading == expected
        assert len(hub.since(0)) == 5
        assert await starting + await numbers(slow, 39) == expected
        for stream in (slow, quick):
            await stream.aclose()

    asyncio.run(play())


def test_what_was_missed_is_read_in_pages(catalog, monkeypatch) -> None:
    for module in (hub_module, stream_module):
        monkeypatch.setattr(module, "PAGE", 10)
    expected = happen(catalog, 35)

    async def play() -> None:
        hub = EventHub(catalog)
        stream = told(hub, feed(catalog))
        await anext(stream)
        assert await numbers(stream, 35) == expected
        await stream.aclose()

    asyncio.run(play())


def test_a_quiet_stream_gives_signs_of_life(catalog, monkeypatch) -> None:
    monkeypatch.setattr(stream_module, "HEARTBEAT_SECONDS", 0.05)

    async def play() -> None:
        stream = told(EventHub(catalog), feed(catalog))
        assert await anext(stream) == b"retry: 2000\n\n"
        assert await anext(stream) == await anext(stream) == b": ping\n\n"
        await stream.aclose()

    asyncio.run(play())


def test_streams_end_when_the_hub_closes(catalog) -> None:
    async def play() -> None:
        hub = EventHub(catalog)
        stream = told(hub, feed(catalog))
        await anext(stream)
        ending = asyncio.create_task(anext(stream, None))
        while not hub.listeners:
            await asyncio.sleep(0)
        hub.close()
        assert await ending is None

    asyncio.run(play())


def test_a_stream_does_not_outlive_its_credentials_for_long(catalog, monkeypatch) -> None:
    monkeypatch.setattr(stream_module, "LIFE_SECONDS", 0.05)
    monkeypatch.setattr(stream_module, "HEARTBEAT_SECONDS", 0.02)

    async def play() -> None:
        hub = EventHub(catalog)
        assert {piece async for piece in told(hub, feed(catalog))} <= {b"retry: 2000\n\n", b": ping\n\n"}
        assert hub.listeners == 0

    asyncio.run(play())


def test_a_stream_ends_when_the_log_cannot_be_read(catalog, tmp_path) -> None:
    """The client comes back, and is told then by the route."""

    async def play() -> None:
        gone = Catalog(f"sqlite:///{tmp_path / 'nothing'}")
        (tmp_path / "nothing").mkdir()
        hub = EventHub(catalog)
        happen(catalog)
        stream = told(hub, feed(gone))
        await anext(stream)
        assert await anext(stream, None) is None
        assert hub.listeners == 0

    asyncio.run(play())


def test_a_stream_holds_its_opening_no_longer_than_it_takes_to_send(catalog, monkeypatch) -> None:
    """A job's snapshot may have 2 MB, and 500 streams live 15 minutes each."""
    monkeypatch.setattr(stream_module, "HEARTBEAT_SECONDS", 0.05)

    async def play() -> None:
        snapshot = bytes(range(200)) * 1000
        before = sys.getrefcount(snapshot)
        stream = told(EventHub(catalog), feed(catalog, opening=(b"data: ", snapshot, b"\n\n")))
        assert await anext(stream) == b"retry: 2000\n\n" and await anext(stream) == b"data: "
        sent = b""
        while not sent.endswith(b"\n\n"):
            piece = await anext(stream)
            assert len(piece) <= stream_module.PIECE
            sent += piece
        assert sent == snapshot + b"\n\n"
        await anext(stream)
        assert sys.getrefcount(snapshot) == before
        await stream.aclose()

    asyncio.run(play())
