"""What every function asks of its arguments, and whether the C++ part is there."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    from l3ps_cluster import _core
except ImportError:  # installed without a compiler
    _core = None  # type: ignore[assignment]

core = _core

native: bool = core is not None
"""Whether the C++ part was built."""


def build() -> str:
    """A digest of the C++ part as built, to tell results apart by what made them; empty where there is none."""
    if core is None:
        return ""
    with open(core.__file__, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


Cancel = Callable[[], None]
"""Asked every 50 ms in the calling thread; stops the work by raising."""


def as_rows(points: ArrayLike, name: str = "points", dimensions: tuple[int, ...] = (3,)) -> NDArray[Any]:
    """The points as C-contiguous rows of float32, or of float64 where that is what came.

    Raises:
        TypeError: when they are not real numbers.
        ValueError: when their shape is another one. That coordinates are finite is checked where they are read.
    """
    rows = np.asarray(points)
    if not (np.issubdtype(rows.dtype, np.floating) or np.issubdtype(rows.dtype, np.integer)):
        raise TypeError(f"{name}: expected real numbers, not {rows.dtype}")
    if rows.ndim != 2 or rows.shape[1] not in dimensions:
        wanted = " or ".join(f"(N, {n})" for n in dimensions)
        raise ValueError(f"{name}: expected an array of shape {wanted}, not {rows.shape}")
    return np.ascontiguousarray(rows, dtype=np.float32 if rows.dtype in (np.float16, np.float32) else np.float64)


def as_count(value: int, name: str, least: int = 1) -> int:
    """A whole number of at least ``least``.

    Raises:
        TypeError: when it is no whole number.
        ValueError: when it is less.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name}: expected a whole number, not {value!r}")
    if value < least:
        raise ValueError(f"{name}: expected {least} or more, not {value}")
    if value > np.iinfo(np.int32).max:
        raise ValueError(f"{name}: expected less than 2^31, not {value}")
    return int(value)


def must_be_finite(points: NDArray[Any], name: str = "points") -> None:
    """Raise ValueError unless every coordinate is a finite number below 1e15, as the C++ part does."""
    if not (np.abs(points) < 1e15).all():
        raise ValueError(f"{name}: every coordinate must be a finite number below 1e15")
