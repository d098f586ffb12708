"""What every format needs of the file system: names that stay inside the folder, and files that appear whole."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from l3ps.drivelog.names import is_plain_name
from l3ps.errors import LabelError, Problem


def file_stem(token: str) -> str:
    """The scan's token as the stem of a file name.

    Tokens come from the tables of a log that anyone may have written, so ``../../x`` must not leave the folder.

    Raises:
        LabelError: the token is no plain file name.
    """
    if not is_plain_name(token):
        raise LabelError(
            Problem(
                code="unsafe-token",
                where=f"scan {token!r}",
                what="its token cannot be a file name",
                remedy="Use letters, digits, '_', '-', '+' and '.' in the log's tokens, 128 at most.",
                scan=token,
            )
        )
    return token


def folder_name(scene: str) -> str:
    """The scene's name as a folder: what cannot stand in a path becomes ``_``; ``00`` where nothing is left."""
    if is_plain_name(scene):
        return scene
    return re.sub(r"[^\w.+-]+", "_", scene).strip(".")[:128].rstrip(".") or "00"


def write_whole(path: Path, content: bytes) -> Path:
    """Write a file that is either complete or absent: into a neighbour first, then renamed over the target.

    Args:
        path: the file; missing folders are made.
        content: all of its bytes.

    Returns:
        ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name[:100]}-", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o644)  # mkstemp makes it private to its owner
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return path
