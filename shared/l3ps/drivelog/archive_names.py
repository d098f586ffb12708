"""Which member names of an archive may become files.

The rules are those of the strictest system a log may later be copied to, and they are applied to the text of a name,
before any file exists: what passes here cannot leave the target folder on any platform.
"""

from __future__ import annotations

import re
import unicodedata
from pathlib import PurePosixPath
from typing import Final

_LONGEST_PART: Final = 255
_LONGEST_PATH: Final = 1024
_DEEPEST: Final = 32
_RESERVED: Final = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)
"""Device names, which Windows opens in place of a file, with any suffix."""
_DRIVE: Final = re.compile(r"[A-Za-z]:")
_UNSEEN: Final = frozenset("\u200b\u200e\u200f\u2028\u2029\u2060\ufeff") | {
    *map(chr, (*range(0x202A, 0x202F), *range(0x2066, 0x206A)))
}
"""Characters without a width, and those that turn the direction of text round: a name is then not what it shows."""


class UnsafeName(ValueError):  # noqa: N818  (the message completes "the member's name …")
    """A member's name cannot be used; the message is a clause that says why."""


def member_path(name: str) -> PurePosixPath:
    """The relative path a member is written to.

    Args:
        name: the name in the archive.

    Returns:
        Its path without ``.`` parts; ``PurePosixPath(".")`` for the archive's own root.

    Raises:
        UnsafeName: absolute, with ``..``, control characters, a backslash or what looks like one of these, not UTF-8,
            reserved, too long or too deep.
    """
    try:
        size = len(name.encode("utf-8"))
    except UnicodeEncodeError as error:
        raise UnsafeName("is not UTF-8") from error
    if any(ord(c) < 32 or 127 <= ord(c) < 160 for c in name):
        raise UnsafeName("has control characters")
    if not _UNSEEN.isdisjoint(name):
        raise UnsafeName("has characters that are not seen, or that turn the text round")
    if "\\" in name:
        raise UnsafeName("has a backslash, which is a separator on some systems")
    if name.startswith("/") or _DRIVE.match(name):
        raise UnsafeName("is absolute")
    if not name:
        raise UnsafeName("is empty")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise UnsafeName("leads out of the archive")
    if size > _LONGEST_PATH or any(len(part.encode("utf-8")) > _LONGEST_PART for part in parts):
        raise UnsafeName(f"is longer than {_LONGEST_PATH} bytes, or {_LONGEST_PART} in one part")
    if len(parts) > _DEEPEST:
        raise UnsafeName(f"is nested deeper than {_DEEPEST} folders")
    for part in parts:
        if _misread(part):
            raise UnsafeName(f"has the part {part!r}, which some systems read as a separator or as '..'")
        if _RESERVED.fullmatch(part.rstrip(" .")) or part[-1] in " .":
            raise UnsafeName(f"has the part {part!r}, which some systems reserve")
    return PurePosixPath(*parts)


def same_file(path: PurePosixPath) -> str:
    """What a path is told apart by on systems that fold case and compose letters: equal for what is one file there."""
    return unicodedata.normalize("NFC", path.as_posix()).casefold()


def _misread(part: str) -> bool:
    """Whether a part becomes dots or gains a separator where look-alikes are folded (U+FF0E, U+2025, U+FF0F …)."""
    if part.isascii():
        return False
    folded = unicodedata.normalize("NFKC", part)
    return folded in (".", "..") or "/" in folded or "\\" in folded


def shown(name: str) -> str:
    """A member's name as a message may show it: one line, printable, not too long."""
    text = name.encode("utf-8", "backslashreplace").decode("utf-8")
    text = "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)
    return text if len(text) <= 120 else text[:80] + "…" + text[-39:]
