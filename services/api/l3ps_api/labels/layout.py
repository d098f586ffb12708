"""Where in a tar its members lie: from their names and sizes, before a byte of them is read."""

from __future__ import annotations

import tarfile
from array import array
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass

END = bytes(2 * tarfile.BLOCKSIZE)


@dataclass(frozen=True, slots=True)
class Layout:
    """The members of a tar, or of a part of one.

    Attributes:
        numbers: which file of a manifest each member is; the last member is none of them.
        starts: where each member's header begins, bytes.
        size: bytes of all, without what ends a tar.
        last: bytes of the last member's content.
    """

    numbers: array[int]
    starts: array[int]
    size: int
    last: int

    @classmethod
    def of(cls, files: Iterable[tuple[int, str, int]], name: str, last: int) -> Layout:
        """From (number, name, size) of each file, and name and size of the last member."""
        numbers, starts, at = array("I"), array("Q"), 0
        for number, path, size in files:
            numbers.append(number)
            starts.append(at)
            at += len(header(path, size, 0)) + padded(size)
        starts.append(at)
        return cls(numbers, starts, at + len(header(name, last, 0)) + padded(last), last)

    def at(self, position: int) -> int:
        """The member that a position lies in."""
        return bisect_right(self.starts, position) - 1


def header(name: str, size: int, modified: int) -> bytes:
    """What stands before a member's content; as long at whatever time it was modified."""
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = size, 0o644, modified
    return info.tobuf(tarfile.PAX_FORMAT, "utf-8", "strict")


def padded(size: int) -> int:
    """The bytes that a content takes up."""
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
