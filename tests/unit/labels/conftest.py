"""A scene that exists only in memory."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from l3ps.drivelog.types import Points, Scan, Scene


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """``make_scene(name, tokens)``: a scene of scans without points or cameras, numbered if asked."""

    def make(name: str, tokens: Sequence[str], numbers: Sequence[str] | None = None) -> Scene:
        empty = Points(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
        return Scene(
            name,
            tuple(
                Scan(token, i, i, Path(f"{i}.bin"), np.eye(4), None, (), lambda: empty, number=number)
                for i, (token, number) in enumerate(zip(tokens, numbers or [None] * len(tokens), strict=True))
            ),
        )

    return make
