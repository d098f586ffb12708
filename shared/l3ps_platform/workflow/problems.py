"""What is wrong with an upload, as rows keep it: the first of very many, the worst before the rest, and their number.

A log may have a problem for each of its scans and files, and every list of drives and every refused job shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from l3ps.errors import Problem
from l3ps_platform.catalog.base import Json

MAX_PROBLEMS = 100
_WORST_FIRST = {"error": 0, "scan": 1, "warning": 2}


def kept_problems(problems: Sequence[Problem]) -> Json | None:
    """The JSON of a row: ``{"problems": [Problem.as_dict()…], "count"}``; None where there is no problem.

    The worst come first, so that those kept tell whether a job may go on without what they concern.
    """
    if not problems:
        return None
    worst = sorted(problems, key=lambda problem: _WORST_FIRST[problem.severity])
    return {"problems": [problem.as_dict() for problem in worst[:MAX_PROBLEMS]], "count": len(problems)}


def problems_of(stored: Json | None) -> list[Problem]:
    """The problems that a row keeps."""
    found: list[dict[str, Any]] = (stored or {}).get("problems", [])
    return [Problem(**problem) for problem in found]


def problem_count(stored: Json | None) -> int:
    """How many problems there were; rows of before they were counted keep them all."""
    stored = stored or {}
    count: int = stored.get("count", len(stored.get("problems", [])))
    return count
