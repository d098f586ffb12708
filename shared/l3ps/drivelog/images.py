"""Size of an image from its header, without decoding it.

Decoding the images of a large log takes hours; a header is a few hundred bytes. The end of the file is looked at as
well, because an interrupted copy keeps its header.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO, Final

_HEAD: Final = 4096
_LONGEST_HEAD: Final = 1 << 20
"""Bytes before the frame header of a JPEG: room for an embedded preview and a colour profile."""
_TAIL: Final = 64
_LONGEST_TAIL: Final = 1 << 16
MAX_PIXELS: Final = 100_000_000
"""A header may claim any size, and a decoder believes it: 100 megapixels are 300 MB; no vehicle camera has as many."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_END: Final = b"\0\0\0\0IEND\xaeB\x60\x82"
_JPEG: Final = b"\xff\xd8\xff"
_JPEG_END: Final = b"\xff\xd9"
_FRAME_HEADERS: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""SOF markers; the three left out define tables or are reserved (ITU-T T.81, table B.1)."""
_STANDALONE: Final = frozenset({0x01, *range(0xD0, 0xD9)})


class BadImage(ValueError):  # noqa: N818  (a clause for a Problem)
    """The file is no whole JPEG or PNG image; the message is a clause that says why."""


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a JPEG or PNG file as stored, in pixels.

    Args:
        path: the image.

    Raises:
        BadImage: empty, neither JPEG nor PNG, header damaged, cut short, or of an absurd size.
        OSError: the file cannot be read.
    """
    with path.open("rb", buffering=0) as file:
        head = file.read(_HEAD)
        if not head:
            raise BadImage("the file is empty")
        if head.startswith(_PNG):
            width, height = _png(head)
            end = _PNG_END
        elif head.startswith(_JPEG):
            width, height = _jpeg(file, head)
            end = _JPEG_END
        else:
            raise BadImage("the file is neither JPEG nor PNG")
        if not width or not height:
            raise BadImage(f"its header gives {width}x{height} pixels")
        if width * height > MAX_PIXELS:
            raise BadImage(f"its header gives {width}x{height} pixels, more than {MAX_PIXELS} in all")
        if end is _PNG_END and head[29:33] != struct.pack(">I", zlib.crc32(head[12:29])):
            raise BadImage("its PNG header is damaged: the checksum does not fit")
        if not _ends_with(file, end):
            raise BadImage("the image is cut short: its end marker is missing")
    return width, height


def _png(head: bytes) -> tuple[int, int]:
    if len(head) < 24 or head[12:16] != b"IHDR":
        raise BadImage("its PNG header is damaged")
    width, height = struct.unpack_from(">II", head, 16)
    return int(width), int(height)


def _jpeg(file: BinaryIO, head: bytes) -> tuple[int, int]:
    position = 2
    while True:
        if position + 9 > len(head):
            more = file.read(_LONGEST_HEAD - len(head)) if len(head) < _LONGEST_HEAD else b""
            if not more:
                raise BadImage("its JPEG header is damaged or cut short")
            head += more
            continue
        if head[position] != 0xFF:
            raise BadImage("its JPEG header is damaged")
        marker = head[position + 1]
        if marker == 0xFF:  # fill bytes may stand before a marker
            position += 1
        elif marker in _STANDALONE:
            position += 2
        elif marker in _FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", head, position + 5)
            return int(width), int(height)
        elif marker in (0xD9, 0xDA):
            raise BadImage("its JPEG header has no size")
        else:
            position += 2 + int(struct.unpack_from(">H", head, position + 2)[0])


def _ends_with(file: BinaryIO, marker: bytes) -> bool:
    """Whether a marker stands near the end; some writers append padding or metadata behind it."""
    size = file.seek(0, 2)
    for reach in (_TAIL, _LONGEST_TAIL):
        file.seek(max(0, size - reach))
        if marker in file.read(reach):
            return True
    return False
