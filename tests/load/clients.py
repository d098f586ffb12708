"""The clients of the load test, in a process of their own: ``python clients.py < plan.json > result.json``.

Each reads its own document once a second over a connection that stays open. A read is due at a fixed time, and what it
took counts from then, so that a service that falls behind cannot hide it by slowing its clients down.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

ANSWER_WITHIN = 30.0


@dataclass
class Seen:
    """What the clients met: seconds of each answer, statuses, faults, and 429s that do not say when to come back."""

    seconds: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    without_retry_after: int = 0


class Connection:
    """One connection, opened again when the service has closed it."""

    def __init__(self, host: str, port: int, headers: dict[str, str]) -> None:
        self._address = host, port
        self._head = "".join(f"{name}: {value}\r\n" for name, value in {"Host": f"{host}:{port}", **headers}.items())
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def get(self, path: str) -> tuple[int, dict[str, str], bytes]:
        """(status, headers, body)."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(*self._address)
        reader, writer = self._streams
        try:
            writer.write(f"GET {path} HTTP/1.1\r\n{self._head}\r\n".encode())
            start, *lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").rstrip().split("\r\n")
            headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
            body = await reader.readexactly(int(headers.get("content-length", 0)))
        except BaseException:
            self.close()
            raise
        if headers.get("connection", "").lower() == "close":
            self.close()
        return int(start.split()[1]), headers, body

    def close(self) -> None:
        """Close it; the next request opens another."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def client(plan: dict[str, Any], number: int, begin: float, seen: Seen) -> None:
    """One client: its own path, once every interval, from its own moment on."""
    connection = Connection(plan["host"], plan["port"], plan["headers"])
    path, interval = plan["paths"][number % len(plan["paths"])], plan["interval"]
    due = begin + interval * number / plan["clients"]
    try:
        while due < begin + plan["seconds"]:
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            try:
                status, headers, body = await asyncio.wait_for(connection.get(path), ANSWER_WITHIN)
                json.loads(body)
                seen.statuses[str(status)] += 1
                seen.without_retry_after += status == 429 and not headers.get("retry-after", "").isdigit()
                seen.seconds.append(time.monotonic() - due)
            except (OSError, EOFError, ValueError, TimeoutError) as error:
                seen.faults[f"{type(error).__name__}: {error}"[:200]] += 1
            due += interval
    finally:
        connection.close()


async def everyone(plan: dict[str, Any]) -> Seen:
    """All clients until the time is over."""
    seen, begin = Seen(), time.monotonic() + 0.5
    await asyncio.gather(*(client(plan, number, begin, seen) for number in range(plan["clients"])))
    return seen


def main() -> None:
    """Do what the plan on standard input says."""
    seen = asyncio.run(everyone(json.load(sys.stdin)))
    ordered = sorted(seen.seconds)

    def percentile(share: float) -> float | None:
        return round(ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1000, 1) if ordered else None

    used = time.process_time()
    json.dump(
        {
            "reads": len(ordered) + sum(seen.faults.values()),
            "statuses": dict(seen.statuses),
            "faults": dict(seen.faults),
            "without_retry_after": seen.without_retry_after,
            "p50_ms": percentile(0.5),
            "p90_ms": percentile(0.9),
            "p99_ms": percentile(0.99),
            "max_ms": percentile(1.0),
            "client_cpu_seconds": round(used, 1),
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()
