"""A scene that exists only in memory."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from l3ps.drivelog.types import Points, Scan, Scene


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """``make_scene(name, tokens)``: a scene of scans without points or cameras."""

    def make(name: str, tokens: Sequence[str]) -> Scene:
        empty = Points(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
        return Scene(
            name,
            tuple(
                Scan(token, i, i, Path(f"{i}.bin"), np.eye(4), None, (), load_points=lambda: empty)
                for i, token in enumerate(tokens)
            ),
        )

    return make
