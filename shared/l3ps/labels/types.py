"""The labels of one scan as they travel between the stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ScanLabels:
    """Panoptic labels of one scan, in point-file order, in the ``NUSCENES16`` space.

    Attributes:
        token: the scan's token.
        semantic: (N,) uint8 class, 0 = void.
        instance: (N,) int32 id, 0 = none; one id never names two objects of a scan.
    """

    token: str
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
