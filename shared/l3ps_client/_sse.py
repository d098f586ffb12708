"""Server-sent events, after the HTML specification's section 9.2."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """Something that happened at the service.

    Attributes:
        id: its place in the order of events; what ``after`` and ``Last-Event-ID`` take.
        kind: such as ``job.succeeded``.
        data: its document; text where it is no JSON.
    """

    id: str
    kind: str
    data: Any


def events(blocks: Iterable[bytes]) -> Iterator[Event | None]:
    """Events out of a stream's bytes; None for each comment, which tells that the service is alive."""
    last_id, kind, data = "", "", list[str]()
    for line in _lines(blocks):
        if not line:
            if data:
                yield Event(last_id, kind or "message", _parsed("\n".join(data)))
            kind, data = "", []
            continue
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        match name:
            case "":
                yield None
            case "id" if "\0" not in value:
                last_id = value
            case "event":
                kind = value
            case "data":
                data.append(value)
            case _:
                pass


def _lines(blocks: Iterable[bytes]) -> Iterator[str]:
    """Lines ended by CR, LF or both, and by nothing else that Unicode knows."""
    rest = b""
    for block in blocks:
        rest += block
        # A CR at the end may be half of a line's end.
        held = b"\r" if rest.endswith(b"\r") else b""
        *whole, rest = rest.removesuffix(held).replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        rest += held
        for line in whole:
            yield line.decode("utf-8", "replace")


def _parsed(data: str) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        return data
