"""Nearest neighbours, single linkage and the filling of noise; on SciPy where the C++ part is missing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l3ps_cluster import fallback
from l3ps_cluster.points import Cancel, as_count, as_rows, core, must_be_finite


def nearest(
    points: ArrayLike,
    queries: ArrayLike,
    k: int = 1,
    *,
    max_distance: float = np.inf,
    threads: int = 2,
    cancel: Cancel | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The k nearest points of each query; of equally near ones any, but always the same.

    Args:
        points: (N, 3) or (N, 2) float32; float64 is taken relative to the points' mean, then rounded.
        queries: (M, 3) or (M, 2) float32, likewise.
        k: how many, 1 or more.
        max_distance: nothing farther than this is found.
        threads: threads of the search.
        cancel: asked every 50 ms; what it raises stops the work and comes out here.

    Returns:
        (M, k) float32 distances, nearest first, infinite where there are no more, and (M, k) int32 indices, -1 there.

    Raises:
        TypeError: when an argument is no number.
        ValueError: when a shape is another one, a coordinate is not finite, or a number is out of range.
    """
    rows, asked = as_rows(points, dimensions=(2, 3)), as_rows(queries, "queries", dimensions=(2, 3))
    if rows.shape[1] != asked.shape[1]:
        raise ValueError(f"queries: expected {rows.shape[1]} coordinates as the points have, not {asked.shape[1]}")
    k, threads = as_count(k, "k"), as_count(threads, "threads")
    if not max_distance >= 0:
        raise ValueError(f"max_distance: expected 0 or more, not {max_distance}")
    near, also_near = _around_one_centre(rows, asked)
    if core is None:
        must_be_finite(near)
        must_be_finite(also_near, "queries")
        return fallback.nearest(near, also_near, k, max_distance, threads)
    return core.nearest(near, also_near, k=k, max_distance=max_distance, threads=threads, cancel=cancel)


def link(points: ArrayLike, gap: float, *, threads: int = 2, cancel: Cancel | None = None) -> NDArray[np.int32]:
    """Components of the graph that connects points no farther than ``gap`` from each other: single linkage, cut there.

    Takes time in proportion to the points, however many lie within the gap of one another.

    Args:
        points: (N, 3) or (N, 2) float32; float64 is taken relative to its mean, then rounded.
        gap: in the unit of the points, 0 or more.
        threads: threads of what can be shared.
        cancel: asked every 50 ms; what it raises stops the work and comes out here.

    Returns:
        (N,) int32 component, numbered from 0 in the order of their first points.

    Raises:
        TypeError: when an argument is no number.
        ValueError: when the shape is another one, a coordinate is not finite, or the gap is negative or not finite.
    """
    rows = as_rows(points, dimensions=(2, 3))
    if not 0 <= gap < np.inf:
        raise ValueError(f"gap: expected a finite number of 0 or more, not {gap}")
    threads = as_count(threads, "threads")
    (near,) = _around_one_centre(rows)
    if core is None:
        must_be_finite(near)
        return fallback.link(near, gap)
    return core.link(near, gap=gap, threads=threads, cancel=cancel)


def fill_noise(
    points: ArrayLike, labels: ArrayLike, k: int = 3, *, threads: int = 2, cancel: Cancel | None = None
) -> NDArray[np.int32]:
    """Give each point labelled -1 the most frequent label among its k nearest points that have one.

    Args:
        points: (N, 3) or (N, 2) float32 or float64.
        labels: (N,) whole numbers, -1 for noise.
        k: neighbours that decide; of equally near ones those of lower index.
        threads: threads of the search.
        cancel: asked every 50 ms; what it raises stops the work and comes out here.

    Returns:
        (N,) int32; of equally frequent labels a point takes the lowest. Without any label all stay -1.

    Raises:
        TypeError: when an argument is no number.
        ValueError: when a shape is another one or a coordinate is not finite.
    """
    rows = as_rows(points, dimensions=(2, 3))
    given = np.asarray(labels)
    if not np.issubdtype(given.dtype, np.integer):
        raise TypeError(f"labels: expected whole numbers, not {given.dtype}")
    if given.shape != (len(rows),):
        raise ValueError(f"labels: expected shape ({len(rows)},) as there are points, not {given.shape}")
    known = np.ascontiguousarray(given, dtype=np.int32)
    k, threads = as_count(k, "k"), as_count(threads, "threads")
    if core is None:
        must_be_finite(rows)
        return fallback.fill_noise(rows, known, k, threads)
    return core.fill_noise(rows, known, k=k, threads=threads, cancel=cancel)


def _around_one_centre(points: NDArray[Any], *others: NDArray[Any]) -> tuple[NDArray[np.float32], ...]:
    """All as float32, relative to the points' mean where any of them came as float64."""
    if all(rows.dtype == np.float32 for rows in (points, *others)):
        return points, *others
    centre = points.mean(axis=0, dtype=np.float64) if len(points) else np.zeros(points.shape[1])
    with np.errstate(invalid="ignore"):  # what is not finite is refused where it is read
        return tuple((rows - centre).astype(np.float32) for rows in (points, *others))
