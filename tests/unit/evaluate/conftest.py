"""A drive that exists only in memory."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from l3ps.drivelog.types import Drive, Points, Scan, Scene, Truth


@pytest.fixture
def make_drive() -> Callable[..., Drive]:
    """``make_drive({"scene": [Truth, None, …]}, truth_space=…)``: one scan a truth, no cameras; tokens s0, s1, …"""

    def make(scenes: dict[str, list[Truth | None]], truth_space: str = "nuscenes") -> Drive:
        built, number = [], 0
        for name, truths in scenes.items():
            scans = []
            for index, truth in enumerate(truths):
                n = 0 if truth is None else len(truth.semantic)
                points = Points(np.zeros((n, 3), np.float32), np.zeros(n, np.float32))
                scans.append(
                    Scan(
                        token=f"s{number}",
                        index=index,
                        timestamp=number,
                        path=Path(f"{number}.bin"),
                        lidar_to_ego=np.eye(4),
                        ego_to_world=None,
                        cameras=(),
                        load_points=lambda points=points: points,
                        load_truth=None if truth is None else lambda truth=truth: truth,
                    )
                )
                number += 1
            built.append(Scene(name, tuple(scans)))
        log_format = "nuscenes" if truth_space == "nuscenes" else "semantickitti"
        return Drive(Path("some-log"), log_format, tuple(built), truth_space)

    return make
