from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

def hdbscan(
    points: NDArray[Any],
    min_cluster_size: int,
    min_samples: int,
    keep_tree: bool,
    threads: int,
    cancel: Callable[[], None] | None,
) -> tuple[NDArray[np.int32], float, NDArray[np.int32], NDArray[np.float64]]: ...
def nearest(
    points: NDArray[np.float32],
    queries: NDArray[np.float32],
    k: int,
    max_distance: float,
    threads: int,
    cancel: Callable[[], None] | None,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]: ...
def link(
    points: NDArray[np.float32], gap: float, threads: int, cancel: Callable[[], None] | None
) -> NDArray[np.int32]: ...
def fill_noise(
    points: NDArray[Any], labels: NDArray[np.int32], k: int, threads: int, cancel: Callable[[], None] | None
) -> NDArray[np.int32]: ...
def instruction_set() -> str: ...
def choose_instruction_set(name: str) -> bool: ...
