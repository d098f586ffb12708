"""The one error tree.

    L3psError
    ├── InputError            the caller's data is at fault; the message says what, where and what to do
    │   ├── DriveLogError     an archive or a drive log (carries every problem found, not only the first)
    │   ├── ModelError        a model bundle
    │   ├── LabelError        label files
    │   └── AnnotationError   annotated images to train from (carries every problem found, up to a bound)
    ├── ProcessingError       a stage could not do its work on valid input (odometry diverged, …)
    ├── Starved               the machine had too little memory or time for it; later or elsewhere it may work
    └── Cancelled             the caller asked to stop

Every message is one sentence that a person who has never seen the code can act on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing wrong with an input.

    Attributes:
        code: stable machine-readable name in kebab-case, e.g. ``truncated-scan``.
        where: the file (relative to the log), table or field at fault.
        what: what is wrong, one clause, with the numbers seen and expected.
        remedy: what the user can do about it.
        severity: ``error`` stops the scene, ``scan`` spoils only that scan, ``warning`` spoils nothing.
        scene: name of the scene concerned, where there is one.
        scan: token of the scan concerned, where there is one.
    """

    code: str
    where: str
    what: str
    remedy: str
    severity: Literal["error", "scan", "warning"] = "error"
    scene: str | None = None
    scan: str | None = None

    def __str__(self) -> str:
        return f"{self.where}: {self.what}. {self.remedy}"

    def as_dict(self) -> dict[str, str | None]:
        """The problem as plain data, for JSON."""
        return asdict(self)


class L3psError(Exception):
    """Root of every error this project raises on purpose."""


class InputError(L3psError):
    """The caller's data is at fault. Carries all problems found; the message is the first and a count."""

    def __init__(self, problems: Problem | Iterable[Problem]) -> None:
        self.problems: tuple[Problem, ...] = (problems,) if isinstance(problems, Problem) else tuple(problems)
        if not self.problems:
            raise ValueError("an InputError needs at least one problem")
        more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
        super().__init__(f"{self.problems[0]}{more}")


class DriveLogError(InputError):
    """An archive or drive log cannot be used."""


class ModelError(InputError):
    """A model bundle cannot be used."""


class LabelError(InputError):
    """Label files cannot be used."""


class AnnotationError(InputError):
    """Annotated images cannot be used."""


class ProcessingError(L3psError):
    """A stage could not do its work on valid input."""


class Starved(L3psError):  # noqa: N818  (what the machine did, no fault of the input)
    """The machine had too little of something; later, or on another one, the same may work.

    Attributes:
        lack: of what.
    """

    def __init__(self, message: str, lack: Literal["memory", "time"]) -> None:
        self.lack = lack
        super().__init__(message)


class Cancelled(L3psError):  # noqa: N818  (it is a request carried out, not an error)
    """The caller asked to stop; nothing half-done is left behind."""


def first_line(error: BaseException) -> str:
    """What somebody else's exception says, fit for a clause of one of our sentences."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
