"""Names that come out of a log: which of them may become part of a path.

A log is somebody else's data. A file name in a table may point anywhere, and a token or a scene's name becomes the name
of a label file, so both are judged before anything is opened or written.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Final

from ..errors import Problem

_FILE: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,127}")
_PLAIN: Final = re.compile(r"[\w+-][\w .+-]{0,126}[\w+-]|[\w+-]")


def is_file_name(value: object) -> bool:
    """Whether a token may name a file: at most 128 ASCII letters, digits and ``. _ + -``, a letter or digit first."""
    return isinstance(value, str) and _FILE.fullmatch(value) is not None


def is_plain_name(value: object) -> bool:
    """Whether a scene or channel may be shown and name a folder.

    At most 128 letters of any script, digits, spaces and ``. _ + -``; no dot or space first or last.
    """
    return isinstance(value, str) and _PLAIN.fullmatch(value) is not None


def is_inside(name: str) -> bool:
    """Whether a relative path stays inside the folder it is joined to (judged by its text alone)."""
    if not name or "\\" in name or any(ord(c) < 32 or ord(c) == 127 for c in name) or len(name) > 1024:
        return False
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and path.parts != ()


def resolve(root: Path, name: str, where: str, *, scene: str | None = None, scan: str | None = None) -> Path | Problem:
    """The file a table names, inside the log.

    A link that the owner of a directory put there himself is followed; archives with links are refused on unpacking.

    Args:
        root: the log.
        name: the file name from the table.
        where: the table, for the message.
        scene: the scene concerned.
        scan: the scan concerned.

    Returns:
        The path, or the problem when the name leads out of the log.
    """
    if is_inside(name):
        return root / name
    return Problem(
        "unsafe-path",
        where,
        f"the file name {name[:120]!r} leads out of the log",
        "Name files relative to the log's folder, without '..'",
        scene=scene,
        scan=scan,
    )


def is_hidden(path: Path) -> bool:
    """Files that operating systems scatter: ``.DS_Store``, ``._000000.bin``, ``__MACOSX``."""
    return path.name.startswith(".") or path.name == "__MACOSX"


def subfolders(folder: Path) -> list[Path]:
    """The visible folders in a folder, sorted by name; empty when it cannot be read."""
    try:
        return sorted(p for p in folder.iterdir() if not is_hidden(p) and p.is_dir())
    except OSError:
        return []
