"""The classes file: what the numbers or names in an annotation mean.

    {"classes": [{"id": 0, "name": "sky", "nuscenes": "void"},
                 {"id": 8, "name": "car", "nuscenes": "car"},
                 {"id": 9, "name": "car", "nuscenes": "car"}],          two ids, one class
     "void": [11]}                                                      ids that are not annotated

Formats that name their categories (COCO, nuImages) may be matched by name: an entry without ``id`` means the category
``category``, or of its own ``name``. ``nuscenes``, a class of Panoptic nuScenes by name or number, may be left out
where the name says it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from l3ps.errors import AnnotationError, Problem
from l3ps.taxonomy import NUSCENES16

from .names import SKY, known_class, nuscenes_class
from .types import NUSCENES_AND_SKY, ClassSet

_LARGEST_FILE: Final = 1 << 20
_MOST_CLASSES: Final = 255
"""Classes are stored in a byte, and 0 is void."""
EXAMPLE: Final = '{"classes": [{"id": 0, "name": "sky", "nuscenes": "void"}], "void": [255]}'

Key = int | str


@dataclass(frozen=True)
class Mapped:
    """Classes and how a format's own ids and names lead to them.

    Attributes:
        classes: the classes.
        index: id or name in the annotation → class; 0 for what is void on purpose.
    """

    classes: ClassSet
    index: Mapping[Key, int]


NUSCENES_IDS: Final = Mapped(NUSCENES_AND_SKY, {i: i for i in range(len(NUSCENES_AND_SKY))})
"""What a plain folder means without a classes file."""


def read_classes(path: Path) -> Mapped:
    """Read a classes file.

    Raises:
        AnnotationError: with everything that is wrong with it.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise _error(path, f"it has more than {_LARGEST_FILE} bytes", "Name the classes file")
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise _error(path, f"it cannot be read ({error.strerror or error})", "Name the classes file") from error
    except (ValueError, RecursionError) as error:
        raise _error(path, f"it is not valid JSON ({error})", f"Write it like {EXAMPLE}") from error
    if not isinstance(content, dict) or not isinstance(content.get("classes"), list) or not content["classes"]:
        raise _error(path, "it has no list 'classes'", f"Write it like {EXAMPLE}")
    return _Table(path).read(content)


class _Table:
    """A classes file in the reading."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._problems: list[Problem] = []
        self._index: dict[Key, int] = {}
        self._targets: dict[str, int] = {}

    def read(self, content: dict[str, Any]) -> Mapped:
        for number, entry in enumerate(content["classes"], start=1):
            self._entry(f"entry {number} of 'classes'", entry)
        void = content.get("void", [])
        if isinstance(void, list) and all(_is_key(key) for key in void):
            for key in void:
                self._add(key, 0, f"'void' lists {key!r}, which is a class as well")
        else:
            self._wrong("'void' is no list of ids or names")
        if len(self._targets) > _MOST_CLASSES:
            self._wrong(f"it names {len(self._targets)} classes, more than {_MOST_CLASSES}")
        if self._problems:
            raise AnnotationError(self._problems)
        return Mapped(ClassSet(("void", *self._targets), (0, *self._targets.values())), self._index)

    def _entry(self, which: str, entry: Any) -> None:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name.strip() or len(name) > 100:
            return self._wrong(f"{which} has no 'name'")
        if name == "void":
            return self._wrong(f"{which} is called void; list its id under 'void' instead")
        key = entry.get("id", entry.get("category", name))
        if not _is_key(key):
            return self._wrong(f"{which} ({name}) has an id that is neither a number from 0 on nor a name")
        if "nuscenes" in entry:
            target = nuscenes_class(entry["nuscenes"])
        else:
            known = known_class(name)
            target = None if known is None else 0 if known == SKY else NUSCENES16.index(known)
        if target is None:
            classes = ", ".join(NUSCENES16.classes)
            return self._wrong(f"{which} ({name}) has no 'nuscenes' that is one of {classes}")
        if self._targets.setdefault(name, target) != target:
            return self._wrong(f"{which} ({name}) is mapped to another class than an entry before of the same name")
        return self._add(key, list(self._targets).index(name) + 1, f"{which} has the id {key!r} of another class")

    def _add(self, key: Key, index: int, otherwise: str) -> None:
        if self._index.setdefault(key, index) != index:
            self._wrong(otherwise)

    def _wrong(self, what: str) -> None:
        self._problems.append(Problem("bad-classes", str(self._path), what, "Correct the classes file"))


def _is_key(value: object) -> bool:
    return (isinstance(value, str) and bool(value)) or (
        isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 31
    )


def _error(path: Path, what: str, remedy: str) -> AnnotationError:
    return AnnotationError(Problem("bad-classes", str(path), what, remedy))
