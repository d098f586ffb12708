"""A proxy in front of the object store that does what networks and servers do on a bad day.

It passes HTTP/1.1 through byte by byte, so signatures stay valid for its own address, and lets rules act on requests
by method, key pattern and the how-manieth it is.
"""

import asyncio
import re
import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

_BLOCK = 1 << 16


@dataclass
class Rule:
    """What happens to some requests.

    Attributes:
        method: ``GET``, ``PUT`` …
        pattern: searched in the path.
        nth: which of the matching requests, from 1; empty for all.
        before: called before the request is passed on, ``after`` when its answer is there and the client waits for it.
        delay: seconds before it is passed on.
        truncate: the answer's body ends half way, and with it the connection.
        armed: whether it acts and counts at all yet.
    """

    method: str
    pattern: str
    nth: Collection[int] = ()
    before: Callable[[], None] | None = None
    after: Callable[[], None] | None = None
    delay: float = 0.0
    truncate: bool = False
    armed: bool = True
    seen: int = field(default=0, init=False)
    hits: int = field(default=0, init=False)

    def takes(self, method: str, path: str) -> bool:
        if not self.armed or method != self.method or not re.search(self.pattern, path):
            return False
        self.seen += 1
        if self.nth and self.seen not in self.nth:
            return False
        self.hits += 1
        return True


class Proxy:
    """A running proxy; a context manager."""

    def __init__(self, target: int, rules: list[Rule]) -> None:
        self.rules, self._target = rules, target
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> "Proxy":
        self._thread.start()
        start = asyncio.start_server(self._serve, "127.0.0.1", 0)
        self._server = asyncio.run_coroutine_threadsafe(start, self._loop).result(10)
        self.port: int = self._server.sockets[0].getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(30)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _serve(self, client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        upstream: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        try:
            while True:
                head = await client.readuntil(b"\r\n\r\n")
                method, path = head.split(b" ", 2)[0].decode(), head.split(b" ", 2)[1].decode()
                rules = [rule for rule in self.rules if rule.takes(method, path)]
                for rule in rules:
                    await asyncio.sleep(rule.delay)
                    if rule.before is not None:
                        await asyncio.to_thread(rule.before)
                if upstream is None:
                    upstream = await asyncio.open_connection("127.0.0.1", self._target)
                server, to_server = upstream
                to_server.write(head)
                await _copy(client, to_server, _length(head, 0))
                if not await self._answer(method, rules, server, to_client):
                    return
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError, asyncio.LimitOverrunError):
            pass  # either side is gone; the other one learns it now
        finally:
            for writer in (to_client, *([upstream[1]] if upstream else [])):
                writer.transport.abort()

    async def _answer(
        self, method: str, rules: list[Rule], server: asyncio.StreamReader, to_client: asyncio.StreamWriter
    ) -> bool:
        """Pass an answer on; False when the connection is to end with it."""
        head = await server.readuntil(b"\r\n\r\n")
        status = head.split(b" ", 2)[1]
        for rule in rules:
            if rule.after is not None:
                await asyncio.to_thread(rule.after)
        to_client.write(head)
        if method == "HEAD" or status in (b"204", b"304"):
            await to_client.drain()
            return True
        if b"transfer-encoding: chunked" in head.lower():
            return await _copy_chunks(server, to_client)
        length = _length(head, 0)
        if length and any(rule.truncate for rule in rules):
            await _copy(server, to_client, length // 2)
            await asyncio.sleep(0.05)  # the half shall arrive before the end does
            return False
        await _copy(server, to_client, length)
        return True


def _length(head: bytes, default: int) -> int:
    found = re.search(rb"^content-length:\s*(\d+)\r$", head, re.IGNORECASE | re.MULTILINE)
    return int(found[1]) if found else default


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter, length: int) -> None:
    while length:
        block = await source.read(min(length, _BLOCK))
        if not block:
            raise ConnectionResetError
        length -= len(block)
        target.write(block)
        await target.drain()
    await target.drain()


async def _copy_chunks(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> bool:
    while True:
        line = await source.readuntil(b"\r\n")
        target.write(line)
        size = int(line.split(b";")[0], 16)
        await _copy(source, target, size + 2)
        if size == 0:
            return True
