"""Which files beside an ONNX graph it wants its weights from.

The graph is walked on the wire, without ONNX's own classes: nothing is copied, a hostile file cannot make the parser
allocate a hundred times its size, and a service that only looks at bundles needs no further package.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

PLAIN_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,199}$"
"""What a file of a bundle that another names may be called: no folder, no drive, no hidden file."""

MAX_FIELDS = 2_000_000
"""Wire fields of one graph; a ViT-g has under 100,000."""
MAX_DIMS = 64

_MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
"""Field numbers of onnx.proto that lead to tensors."""
_DIMS, _TYPE, _NAME, _ENTRY, _PLACE = 1, 2, 8, 13, 14
_ELEMENT_BYTES = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8, 16: 2}
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


@dataclass(frozen=True, slots=True)
class ExternalTensor:
    """An initializer whose bytes lie in a file: ``size`` bytes from ``offset`` of ``location``."""

    name: str
    location: str
    offset: int
    size: int


def external_tensors(graph: bytes) -> list[ExternalTensor]:
    """The initializers of a serialised model that lie in files beside it.

    Args:
        graph: the serialised ``ModelProto``.

    Raises:
        ValueError: one clause that says what is wrong with the graph: it cannot be read, or a tensor lies where the
            runtime would open it by path.
    """
    # Every tensor with external data has an entry of this key, so most graphs need no walk.
    if b"location" not in graph:
        return []
    try:
        return list(_walk(graph))
    except IndexError as error:
        raise ValueError("it is no ONNX graph: a field runs past the end") from error


def _walk(data: bytes) -> Iterator[ExternalTensor]:
    wire = _Wire(data)
    stack = [("model", 0, len(data), False)]
    while stack:
        kind, start, end, nested = stack.pop()
        for number, type_, value, stop in wire.fields(start, end):
            child = _MESSAGES[kind].get(number)
            if child is None or type_ != _BYTES:
                continue
            if child != "tensor":
                inner = nested or (kind, child) not in {("model", "graph"), ("graph", "node")}
                stack.append((child, value, stop, inner))
            elif (found := _external(wire, value, stop)) is not None:
                # ONNX Runtime takes bytes in memory for these alone and opens the others' files by path.
                if kind != "graph" or nested:
                    raise ValueError(f"tensor '{found.name}' has external data but is no initializer of the main graph")
                yield found


def _external(wire: _Wire, start: int, end: int) -> ExternalTensor | None:
    """What a tensor says of its external data; None when it has none."""
    dims: list[int] = []
    element, name, elsewhere = 0, "", False
    entries: list[tuple[str, str]] = []
    for number, type_, value, stop in wire.fields(start, end):
        if number == _DIMS:
            dims += [value] if type_ == _VARINT else wire.packed(value, stop)
        elif number == _TYPE:
            element = value
        elif number == _PLACE:
            elsewhere |= value == 1
        elif number == _NAME:
            name = wire.text(value, stop)
        elif number == _ENTRY:
            pair = {n: wire.text(v, s) for n, w, v, s in wire.fields(value, stop) if w == _BYTES}
            entries.append((pair.get(1, ""), pair.get(2, "")))
    if not entries and not elsewhere:
        return None
    values = dict(entries)
    if len(values) < len(entries):
        raise ValueError(f"tensor '{name}' says twice where its data lies")
    location = values.get("location", "")
    if not re.fullmatch(PLAIN_NAME, location):
        raise ValueError(f"tensor '{name}' wants its data from {location[:100]!r}, which is no file of the bundle")
    if element not in _ELEMENT_BYTES or len(dims) > MAX_DIMS:
        raise ValueError(f"tensor '{name}' has external data of a type ({element}) or rank ({len(dims)}) unknown here")
    size = math.prod(dims) * _ELEMENT_BYTES[element]
    try:
        offset, length = int(values.get("offset", "0")), int(values.get("length", size))
    except ValueError as error:
        raise ValueError(f"tensor '{name}' has an external offset or length that is no number") from error
    if offset < 0 or length != size:
        raise ValueError(f"tensor '{name}' takes {size} bytes, its external data is {length} from {offset}")
    return ExternalTensor(name, location, offset, size)


class _Wire:
    """Serialised protobuf, read field by field up to a limit."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._left = MAX_FIELDS

    def fields(self, start: int, end: int) -> Iterator[tuple[int, int, int, int]]:
        """(number, wire type, value or start, stop) of the fields of one message."""
        at = start
        while at < end:
            self._left -= 1
            if self._left < 0:
                raise ValueError(f"it has more than {MAX_FIELDS} parts")
            key, at = self._varint(at)
            number, type_ = key >> 3, key & 7
            value = at
            if type_ == _VARINT:
                value, at = self._varint(at)
            elif type_ == _BYTES:
                length, value = self._varint(at)
                at = value + length
            elif type_ in {_FIXED32, _FIXED64}:
                at += 4 if type_ == _FIXED32 else 8
            else:
                raise ValueError("it is no ONNX graph: a field has an unknown wire type")
            if at > end:
                raise IndexError
            yield number, type_, value, at

    def packed(self, at: int, end: int) -> list[int]:
        """The numbers of a packed field, up to one more than a tensor's dimensions may be."""
        values: list[int] = []
        while at < end and len(values) <= MAX_DIMS:
            value, at = self._varint(at)
            values.append(value)
        return values

    def text(self, start: int, stop: int) -> str:
        """A string; those too long for a name or a path come back empty."""
        return self._data[start:stop].decode("utf-8", "replace") if stop - start <= 4096 else ""

    def _varint(self, at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            byte = self._data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value, at
            shift += 7
            if shift > 63:
                raise ValueError("it is no ONNX graph: a number has more than ten bytes")
