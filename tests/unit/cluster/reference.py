"""HDBSCAN by brute force, and by the package's own functions where the order of equal edges is given."""

import numpy as np
from hdbscan._hdbscan_linkage import label
from hdbscan.hdbscan_ import _tree_to_labels
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist


def reachability(points, min_samples):
    """(N, N) float64 distances and mutual reachability distances."""
    distance = cdist(points.astype(np.float64), points.astype(np.float64))
    core = np.sort(distance, axis=1)[:, min(min_samples, len(points) - 1)]  # the first is the point itself
    return distance, np.maximum(np.maximum(distance, core[:, None]), core[None, :])


def tree_weight(points, min_samples):
    """Weight of SciPy's minimum spanning tree. All edges are lifted, since SciPy takes those of zero for none."""
    _, weight = reachability(points, min_samples)
    lift = weight.max() or 1.0
    return minimum_spanning_tree(weight + lift).sum() - lift * (len(points) - 1)


def labels(points, min_cluster_size, min_samples):
    """Labels from Kruskal's tree, edges ordered by weight, then length, then ends."""
    distance, weight = reachability(points, min_samples)
    low, high = np.triu_indices(len(points), 1)
    order = np.lexsort((high, low, distance[low, high], weight[low, high]))
    return labels_of_tree(*_kruskal(len(points), low[order], high[order], weight[low, high][order]), min_cluster_size)


def labels_of_tree(ends, weights, min_cluster_size):
    """Labels that the package makes of a spanning tree, lightest edge first."""
    linkage = label(np.column_stack([ends.astype(np.float64), weights]))
    return _tree_to_labels(None, linkage, min_cluster_size)[0]


def same_partition(a, b):
    """Whether two labellings differ in nothing but the numbers of their clusters; noise is -1 in both."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return len(pairs) == len(set(a.tolist())) == len(set(b.tolist())) and all((x < 0) == (y < 0) for x, y in pairs)


def _kruskal(count, low, high, weight):
    parent = list(range(count))

    def root(of):
        while parent[of] != of:
            of = parent[of]
        return of

    kept = []
    for edge, (a, b) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        if (one := root(a)) != (other := root(b)):
            parent[one] = other
            kept.append(edge)
    return np.column_stack([low[kept], high[kept]]), weight[kept]
