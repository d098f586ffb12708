"""Folders that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from l3ps.errors import InputError, Problem


def check_arguments(out: Path, width: int, least: Sequence[tuple[str, int, int]]) -> None:
    """Refuse what nothing can be drawn from, or to.

    Args:
        out: must not exist or be empty.
        width: of the pictures in pixels, a multiple of 16.
        least: name, value and lowest value of further arguments.

    Raises:
        InputError: with everything that is wrong.
    """
    problems = [
        Problem("out-of-range", name, f"{value} is too small; at least {lowest} is needed", f"Ask for {lowest} or more")
        for name, value, lowest in (*least, ("width", width, 64))
        if value < lowest
    ]
    if width % 16:
        what = f"{width} is not a multiple of 16"
        problems.append(Problem("out-of-range", "width", what, "Ask for a multiple of 16"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        problems.append(Problem("output-in-use", str(out), "it exists and is not empty", "Name a new directory"))
    if problems:
        raise InputError(problems)


@contextmanager
def whole(out: Path) -> Iterator[Path]:
    """A folder to write into, which takes the place of ``out`` at the end and is removed on an error."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as parent:
        staging = Path(parent, out.name)
        staging.mkdir()
        yield staging
        if out.exists():
            out.rmdir()
        staging.rename(out)
