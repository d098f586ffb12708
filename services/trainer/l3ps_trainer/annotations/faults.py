"""Everything wrong with annotations, gathered up to a bound."""

from __future__ import annotations

from pathlib import Path

from l3ps.errors import AnnotationError, Problem

MOST = 20
"""Faults that are told one by one. Where a whole folder is wrong, twenty lines show it as well as three thousand."""


class Faults:
    """Faults found in one source.

    Args:
        root: the annotations; what is said names files relative to it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._found: list[Problem] = []
        self._more = 0

    def __bool__(self) -> bool:
        return bool(self._found)

    def where(self, path: Path) -> str:
        """A file's name as messages show it."""
        return str(path.relative_to(self.root)) if path.is_relative_to(self.root) else str(path)

    def add(self, code: str, where: str | Path, what: str, remedy: str) -> None:
        """Note a fault; only counted when there are many already."""
        if len(self._found) < MOST:
            self._found.append(Problem(code, where if isinstance(where, str) else self.where(where), what, remedy))
        else:
            self._more += 1

    def extend(self, problems: list[Problem]) -> None:
        """Note faults that somebody else found."""
        for problem in problems:
            self.add(problem.code, problem.where, problem.what, problem.remedy)

    def stop(self) -> None:
        """Raise when there are any.

        Raises:
            AnnotationError: with all that were noted and the number of the others.
        """
        if not self._found:
            return
        problems = list(self._found)
        if self._more:
            what = f"{self._more} more fault(s) were found"
            problems.append(Problem("more-faults", self.root.name, what, "Mend those above and try again"))
        raise AnnotationError(problems)
