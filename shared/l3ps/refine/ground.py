"""Ground and non-ground points: Patchwork++ (paper, section III-D, step 2)."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pypatchworkpp
from numpy.typing import NDArray

DEFAULT_SENSOR_HEIGHT = 1.723
"""Metres: KITTI's, Patchwork++'s own default, for logs whose calibration does not tell."""


class GroundSegmenter:
    """Splits the scans of one scene; its thresholds adapt, so scans go in order and a new scene takes a new one.

    Args:
        sensor_height: LiDAR above ground in metres; None takes the default.
    """

    def __init__(self, sensor_height: float | None = None) -> None:
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height = DEFAULT_SENSOR_HEIGHT if sensor_height is None else sensor_height
        parameters.verbose = False
        with _quiet_stdout():
            self._estimator = pypatchworkpp.patchworkpp(parameters)

    def __call__(self, xyz: NDArray[np.float32], intensity: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which points are ground.

        Args:
            xyz: (N, 3) float32, metres, lidar frame; rows that are not finite are no ground.
            intensity: (N,) float32 in 0..1, as the reflected-noise removal expects.

        Returns:
            (N,) bool.
        """
        ground = np.zeros(len(xyz), dtype=bool)
        usable = np.flatnonzero(np.isfinite(xyz).all(axis=1))
        if len(usable):
            self._estimator.estimateGround(np.column_stack([xyz, intensity])[usable].astype(np.float32))
            ground[usable[np.asarray(self._estimator.getGroundIndices(), dtype=np.intp).ravel()]] = True
        return ground


@contextmanager
def _quiet_stdout() -> Iterator[None]:
    """Drop what C++ code writes to standard output.

    Patchwork++ greets on construction even when told not to be verbose, which would spoil a caller's JSON. The C
    library's buffer must be flushed before and after, or the greeting appears when the process ends.
    """
    flush = ctypes.CDLL(None).fflush
    flush(None)
    kept, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        yield
        flush(None)
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(sink)
