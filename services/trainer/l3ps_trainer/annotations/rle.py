"""Masks as COCO stores them: run lengths down the columns, zeros first, packed into printable characters.

Each number takes five bits a character, low bits first; bit 5 says that another character follows, and bit 4 of the
last one is the sign. From the fourth number on, the difference to the number two before is stored (format: maskApi.c
of the COCO API; nuImages wraps the characters in base64).
"""

from __future__ import annotations

import base64
import binascii
from typing import Final

import numpy as np
from numpy.typing import NDArray

_FIRST, _LAST = 48, 48 + 63
_LONGEST: Final = 6
"""Characters of a number: 30 bits, more than any image has pixels."""


class BadMask(ValueError):  # noqa: N818  (a clause for a Problem)
    """Not a mask; the message is a clause that says why."""


def decode_base64(text: str, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask as nuImages stores it; see :func:`decode`."""
    try:
        return decode(base64.b64decode(text, validate=True), size)
    except (binascii.Error, ValueError) as error:
        raise error if isinstance(error, BadMask) else BadMask(f"its mask is not base64 ({error})") from error


def decode(packed: bytes, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Unpack a mask.

    Args:
        packed: the characters.
        size: (height, width).

    Returns:
        (height, width) bool.

    Raises:
        BadMask: the characters are no run lengths that fill the size.
    """
    counts = _counts(packed)
    height, width = size
    if (counts < 0).any() or int(counts.sum()) != height * width:
        raise BadMask(f"its mask does not cover {width}x{height} pixels")
    runs = np.arange(len(counts)) % 2 == 1
    return np.repeat(runs, counts).reshape(width, height).T


def _counts(packed: bytes) -> NDArray[np.int64]:
    """The run lengths."""
    codes = np.frombuffer(packed, dtype=np.uint8).astype(np.int64)
    if codes.size and (codes.min() < _FIRST or codes.max() > _LAST):
        raise BadMask("its mask holds characters that no mask has")
    codes -= _FIRST
    ends = np.flatnonzero((codes & 0x20) == 0)
    if not codes.size or not ends.size or ends[-1] != len(codes) - 1:
        raise BadMask("its mask is cut short" if codes.size else "its mask is empty")
    starts = np.concatenate(([0], ends[:-1] + 1))
    lengths = ends - starts + 1
    if lengths.max() > _LONGEST:
        raise BadMask("its mask holds a number that is far too long")
    place = np.arange(len(codes)) - np.repeat(starts, lengths)
    counts = np.add.reduceat((codes & 0x1F) << (5 * place), starts)
    counts -= np.where(codes[ends] & 0x10, 1 << (5 * lengths), 0)
    counts[1::2] = np.cumsum(counts[1::2])
    counts[2::2] = np.cumsum(counts[2::2])
    return np.asarray(counts, dtype=np.int64)
