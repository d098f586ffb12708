"""A scene too large for the memory, clustered and voted in overlapping chunks along the path.

A chunk is a run of scans. Neighbouring chunks share scans: these are voted in both and kept from the one in which they
lie more central, so that every scan has others around it. Objects are told apart in the whole scene afterwards, so no
id ends at a seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from l3ps.progress import Progress

OVERLAP = 0.25
"""Share of a chunk's points that the next chunk has too."""
BYTES_A_POINT = 300
"""What a chunk needs at its peak, to turn a budget of memory into one of points: measured are 100 to 170. What is kept
of the whole scene meanwhile is 20 a point, and to tell its objects apart, when no chunk is held, takes 80 where half of
the points are things."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Scans that are clustered together.

    Attributes:
        first: first scan.
        stop: the scan after the last.
        kept_first: first scan whose classes are kept: those that lie more central here than in any other chunk.
        kept_stop: the scan after the last of these.
    """

    first: int
    stop: int
    kept_first: int
    kept_stop: int

    @property
    def scans(self) -> slice:
        """Its scans among those of the scene."""
        return slice(self.first, self.stop)

    @property
    def kept(self) -> slice:
        """The kept ones among its scans."""
        return slice(self.kept_first - self.first, self.kept_stop - self.first)


def plan(sizes: Sequence[int], starts: Sequence[int] = (0,), max_points: int | None = None) -> list[Chunk]:
    """Chunks of at most ``max_points`` points; a scan that is larger alone is a chunk of its own.

    Args:
        sizes: points of each scan.
        starts: first scans of the parts that hang together, ascending, 0 first; no chunk reaches over one.
        max_points: None for no limit.

    Returns:
        Chunks in order whose kept scans are all scans, each once.
    """
    total = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
    chunks: list[Chunk] = []
    for start, end in pairwise([*starts, len(sizes)]):
        spans = _spans(total, start, end, max_points)
        if not spans:
            continue
        middles = [(later[0] + earlier[1] + 1) // 2 for earlier, later in pairwise(spans)]
        kept = pairwise([start, *middles, end])
        chunks += [Chunk(*span, *own) for span, own in zip(spans, kept, strict=True)]
    return chunks


def _spans(total: NDArray[np.int64], start: int, end: int, max_points: int | None) -> list[tuple[int, int]]:
    """Overlapping (first, stop) that cover the scans from ``start`` to before ``end``."""
    if start >= end:
        return []
    if max_points is None or total[end] - total[start] <= max_points:
        return [(start, end)]
    spans: list[tuple[int, int]] = []
    first = start
    while True:
        stop = int(np.searchsorted(total, total[first] + max_points, side="right")) - 1
        stop = min(max(stop, first + 1), end)
        spans.append((first, stop))
        if stop == end:
            return spans
        shared = OVERLAP * float(total[stop] - total[first])
        back = int(np.searchsorted(total, total[stop] - shared, side="right")) - 1
        # At least one scan in common where the chunk has two; always one scan further than the chunk before.
        first = max(min(back, stop - 1), first + 1)


def progress_of(progress: Progress, index: int, chunks: int) -> Progress:
    """The progress of one chunk as that of all."""

    def tell(stage: str, done: int, total: int) -> None:
        progress(stage, index * total + done, chunks * total)

    return progress if chunks == 1 else tell
