"""Geometric clusters of the accumulated scene: HDBSCAN per partition (paper, section III-D, step 3)."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

import l3ps_cluster

NOISE = -1
NOISE_NEIGHBOURS = 3
"""Noise points take the majority cluster of their 3 nearest clustered points (published)."""

Clusterer = Callable[[NDArray[np.float32], int, int], NDArray[np.int32]]
"""(points (N, 3), min_cluster_size, threads) → (N,) int32 label, -1 for noise."""


def exact_hdbscan(
    points: NDArray[np.float32],
    min_cluster_size: int,
    threads: int,
    cancel: Callable[[], None] | None = None,
) -> NDArray[np.int32]:
    """HDBSCAN of ``l3ps_cluster``, as the ``hdbscan`` package defines it; by that package where it was not built.

    Args:
        points: (N, 3) float32, metres.
        min_cluster_size: HDBSCAN's s, which is its min_samples too.
        threads: the result does not depend on it.
        cancel: asked every 50 ms; stops the work by raising.
    """
    if not l3ps_cluster.native:
        _warn_of_the_slow_way()
        return hdbscan_package(points, min_cluster_size, threads)
    return l3ps_cluster.HDBSCAN(min_cluster_size, threads=threads).fit_predict(points, cancel)


@functools.cache
def _warn_of_the_slow_way() -> None:
    """Once a process, whatever the warning filters say."""
    warnings.warn(
        "l3ps-cluster was installed without its C++ part, so the hdbscan package clusters, some 50 times slower. "
        "Install a C++ compiler, then run `uv sync --reinstall-package l3ps-cluster`.",
        stacklevel=3,
    )


def build() -> str:
    """What clusters here, for content keys: labels of another build may differ where distances tie."""
    return l3ps_cluster.build()


def hdbscan_package(points: NDArray[np.float32], min_cluster_size: int, threads: int) -> NDArray[np.int32]:
    """HDBSCAN of the ``hdbscan`` package: Euclidean, min_samples = min_cluster_size, excess of mass.

    It runs in this thread alone: asked for more jobs, the package starts processes, which a prefork worker's children
    may not.
    """
    import hdbscan  # noqa: PLC0415  (a second to import, and only needed for comparison)

    del threads
    if len(points) <= min_cluster_size:
        return np.full(len(points), NOISE, dtype=np.int32)
    model = hdbscan.HDBSCAN(min_cluster_size=min_cluster_size, core_dist_n_jobs=1)
    return np.asarray(model.fit_predict(points), dtype=np.int32)


def cluster_scene(
    points: NDArray[np.float32],
    ground: NDArray[np.bool_],
    min_cluster_size: int,
    *,
    threads: int = 2,
    voxel: float | None = None,
    clusterer: Clusterer | None = None,
    cancel: Callable[[], None] | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Cluster ground and non-ground points apart from each other.

    Args:
        points: (N, 3) float32, metres, scene frame.
        ground: (N,) bool partition.
        min_cluster_size: HDBSCAN's s.
        threads: threads of the clusterer.
        voxel: edge in metres of the cells whose centroids are clustered in place of the points; None clusters the
            points themselves, as published.
        clusterer: the implementation; None takes :func:`exact_hdbscan`.
        cancel: asked every 50 ms while the default clusterer works; stops it by raising.

    Returns:
        (N,) int32 cluster ids from 0, unique over both partitions. Points that are not finite keep -1, as do those of
        a partition in which no cluster was found: nothing groups them. And (N,) bool, which points HDBSCAN left out as
        noise and their neighbours' clusters took in.
    """
    if clusterer is None:
        clusterer = functools.partial(exact_hdbscan, cancel=cancel)
    labels = np.full(len(points), NOISE, dtype=np.int32)
    noise = np.zeros(len(points), dtype=bool)
    first_free = 0
    finite = np.isfinite(points).all(axis=1)
    for partition in (~ground, ground):
        members = np.flatnonzero(partition & finite)
        if len(members) == 0:
            continue
        own = points[members]
        seeds, cell = (own, None) if voxel is None else _centroids(own, voxel)
        sure = clusterer(seeds, min_cluster_size, threads)
        found = reassign_noise(seeds, sure, threads)
        if cell is not None:
            sure, found = sure[cell], found[cell]
        noise[members] = (sure == NOISE) & (found != NOISE)
        labels[members] = np.where(found == NOISE, NOISE, found + first_free)
        first_free += int(found.max()) + 1
    return labels, noise


def reassign_noise(points: NDArray[np.float32], labels: NDArray[np.int32], threads: int = 2) -> NDArray[np.int32]:
    """Give each noise point the majority cluster of its nearest clustered points; a tie goes to the lowest id.

    Args:
        points: (N, 3) float32, metres.
        labels: (N,) int32 cluster, -1 for noise.
        threads: threads of the neighbour search.

    Returns:
        (N,) int32 without noise, unless there is no cluster at all.
    """
    return l3ps_cluster.fill_noise(points, labels, NOISE_NEIGHBOURS, threads=threads)


def _centroids(points: NDArray[np.float32], voxel: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Centroid of each occupied cell, and each point's cell."""
    key = np.floor(points / voxel).astype(np.int64)
    key -= key.min(axis=0)
    extent = key.max(axis=0) + 1
    flat = (key[:, 0] * extent[1] + key[:, 1]) * extent[2] + key[:, 2]
    _, cell, count = np.unique(flat, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(cell, weights=points[:, axis]) for axis in range(3)], axis=1)
    return (total / count[:, None]).astype(np.float32), cell
