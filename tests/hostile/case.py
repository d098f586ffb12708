"""What a hostile upload is, and what must become of it."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from .samples import Samples

ONLY = os.environ.get("L3PS_HOSTILE", "")
"""In ``make hostile`` a regular expression of names of cases."""
FULL = bool(ONLY)
"""Whether this is ``make hostile``: every such case on both stacks, with the limits as they ship."""


@dataclass(frozen=True)
class Case:
    """One hostile upload.

    Attributes:
        name: of the case, and of the file.
        make: its bytes.
        codes: the problems it may be refused with; one of them must be among those told.
        where: part of what the problem must name as the place.
        end: who refuses it: the ``completion`` of the upload, the worker's ``check``, or, where only scans are bad
            and could be skipped, the ``job`` that is asked for.
        kind: what it is announced as.
    """

    name: str
    make: Callable[[Samples], bytes]
    codes: frozenset[str]
    where: str = ""
    end: Literal["completion", "check", "job"] = "check"
    kind: Literal["drive", "model"] = "drive"


def case(name: str, make: Callable[[Samples], bytes] | bytes, codes: str, where: str = "", **more: str) -> Case:
    """A case; ``codes`` separated by spaces."""
    content = make
    return Case(
        name,
        content if callable(content) else lambda _: content,
        frozenset(codes.split()),
        where,
        **more,  # type: ignore[arg-type]
    )
