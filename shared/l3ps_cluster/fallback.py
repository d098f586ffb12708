"""The functions on SciPy, for an installation without the C++ part."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def nearest(
    points: NDArray[np.float32], queries: NDArray[np.float32], k: int, max_distance: float, threads: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """As :func:`l3ps_cluster.nearest`, of checked arguments."""
    distance = np.full((len(queries), k), np.inf, dtype=np.float32)
    index = np.full((len(queries), k), -1, dtype=np.int32)
    if len(points) and len(queries):
        limit = np.nextafter(max_distance, np.inf)  # SciPy's bound is exclusive
        found, at = cKDTree(points).query(queries, k=np.arange(1, k + 1), distance_upper_bound=limit, workers=threads)
        known = np.isfinite(found)
        distance[known], index[known] = found[known], at[known]
    return distance, index


def link(points: NDArray[np.float32], gap: float) -> NDArray[np.int32]:
    """As :func:`l3ps_cluster.link`, of checked arguments; its time and memory grow with the pairs within the gap."""
    pairs = cKDTree(points).query_pairs(gap, output_type="ndarray") if len(points) else np.zeros((0, 2), dtype=np.intp)
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    _, component = connected_components(graph, directed=False)
    _, first, number = np.unique(component, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number].astype(np.int32)


def fill_noise(points: NDArray[Any], labels: NDArray[np.int32], k: int, threads: int) -> NDArray[np.int32]:
    """As :func:`l3ps_cluster.fill_noise`, of checked arguments; of equally near points, SciPy's choice counts."""
    noise = labels < 0
    out = labels.copy()
    if not noise.any() or noise.all():
        return out
    clustered = np.flatnonzero(~noise)
    k = min(k, len(clustered))
    _, neighbour = cKDTree(points[clustered]).query(points[noise], k=k, workers=threads)
    votes = np.sort(labels[clustered][neighbour.reshape(-1, k)], axis=1)
    count = (votes[:, :, None] == votes[:, None, :]).sum(axis=2)
    out[noise] = votes[np.arange(len(votes)), count.argmax(axis=1)]
    return out
