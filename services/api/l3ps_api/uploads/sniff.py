"""What the first bytes of a file say it is."""

from __future__ import annotations

HEAD_BYTES = 512
"""Enough for a tar header, whose magic lies at byte 257."""

_MAGICS: tuple[tuple[int, bytes, str], ...] = (
    (0, b"PK\x03\x04", "zip"),
    (0, b"PK\x05\x06", "zip"),  # an empty zip: an archive, though one without a log
    (0, b"\x1f\x8b", "gzip"),
    (0, b"\x28\xb5\x2f\xfd", "zstd"),
    (257, b"ustar", "tar"),
)


def archive_kind(head: bytes) -> str | None:
    """``zip``, ``gzip``, ``zstd`` or ``tar`` by magic number, None for anything else.

    Args:
        head: the first ``HEAD_BYTES`` bytes of the file, or all of a shorter one.
    """
    for offset, magic, kind in _MAGICS:
        if head[offset : offset + len(magic)] == magic:
            return kind
    return None


def describe(head: bytes, kind: str) -> str:
    """A file that is not what it should be, in a few words for a message."""
    wanted = "a zip" if kind == "model" else "a zip, gzip, zstd or tar"
    if not head:
        return "the file is empty (0 bytes)"
    return f"the file begins with the bytes {head[:8].hex(' ')} and is not {wanted}"
