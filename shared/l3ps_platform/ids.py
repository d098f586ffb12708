"""Ids that sort by time: a prefix that says what it names, 48 bits of milliseconds, 74 random bits.

The layout is UUID version 7's (RFC 9562) without its version bits, written in Crockford's base 32, lower case, so that
an id can be double-clicked, read over the phone and used in a path. Within a process ids never go backwards, so rows
made in one transaction sort in the order they were made.
"""

from __future__ import annotations

import re
import secrets
import threading
import time
from datetime import datetime
from typing import Literal, get_args

Prefix = Literal["ann", "arr", "drv", "job", "key", "mdl", "msg", "prj", "rul", "scn", "stg", "trn", "upl", "whk"]

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_RANDOM_BITS = 74
_LENGTH = 25
_lock = threading.Lock()
_last = 0
_PATTERN = re.compile(rf"({'|'.join(get_args(Prefix))})_[{_ALPHABET}]{{{_LENGTH}}}")


def new_id(prefix: Prefix) -> str:
    """A new id, e.g. ``job_01jd…``."""
    global _last  # noqa: PLW0603  (the process' clock hand)
    with _lock:
        fresh = (int(time.time() * 1000) << _RANDOM_BITS) | secrets.randbits(_RANDOM_BITS)
        same_moment = fresh >> _RANDOM_BITS <= _last >> _RANDOM_BITS
        # Within a millisecond, or after the clock was set back: on from the last id, by an unguessable step.
        _last = value = _last + 1 + secrets.randbits(32) if same_moment else fresh
    return _written(prefix, value)


def lowest_id(prefix: Prefix, moment: datetime) -> str:
    """What sorts before every id made at or after a moment, and after every one made before it."""
    milliseconds = min(max(int(moment.timestamp() * 1000), 0), (1 << 48) - 1)
    return _written(prefix, milliseconds << _RANDOM_BITS)


def is_id(text: str, prefix: Prefix) -> bool:
    """Whether ``text`` has the form of an id with this prefix (not whether such a row exists)."""
    return bool(_PATTERN.fullmatch(text)) and text.startswith(prefix)


def _written(prefix: Prefix, value: int) -> str:
    digits = []
    for _ in range(_LENGTH):
        value, digit = divmod(value, 32)
        digits.append(_ALPHABET[digit])
    return f"{prefix}_{''.join(reversed(digits))}"
