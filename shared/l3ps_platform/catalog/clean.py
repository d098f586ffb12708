"""What both databases can keep.

PostgreSQL refuses NUL in text and JSON, lone halves of UTF-16 pairs, and numbers in JSON that are not finite; SQLite
takes the first and the last. Clients' files have all of them, and what is said about a file must be recorded with
whatever it held: a stage whose end is refused cannot end.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any

_UNKEPT = re.compile("[\x00\ud800-\udfff]")


def clean(value: Any) -> Any:
    """The value with U+FFFD for each character that cannot be kept and None for numbers that are not finite.

    Lists, tuples and dicts are gone through, their keys too.
    """
    if isinstance(value, str):
        return _UNKEPT.sub("\N{REPLACEMENT CHARACTER}", value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {clean(key): clean(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [clean(content) for content in value]
    return value


def clean_json(value: Any) -> str:
    """A JSON document as the catalog keeps it."""
    return json.dumps(clean(value), allow_nan=False)


def clean_parameters(parameters: Any) -> Any:
    """The parameters of a statement, of one row or of many, with :func:`clean` text; other types stay as they are."""
    if isinstance(parameters, str):
        return clean(parameters)
    if isinstance(parameters, dict):
        return {name: clean_parameters(value) for name, value in parameters.items()}
    if isinstance(parameters, list | tuple):
        return type(parameters)(clean_parameters(value) for value in parameters)
    return parameters
