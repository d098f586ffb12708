"""HDBSCAN with the face of scikit-learn's estimators."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l3ps_cluster.points import Cancel, as_count, as_rows, core


class HDBSCAN:
    """Exact HDBSCAN* of 3D points: Euclidean, excess of mass, as the ``hdbscan`` package defines it.

    The core distance of a point is that to its ``min_samples``-th nearest other point. The minimum spanning tree of
    mutual reachability is exact (the package's own is approximate by default). Edges of equal weight merge in the order
    of their Euclidean length, then of their points' indices; the package leaves that order to chance. So where all
    distances differ, no permutation of the points changes their partition.

    Float64 coordinates are taken relative to their mean and then rounded to float32, so that UTM coordinates keep
    millimetres; distances are computed in float32, the tree's weight is summed in float64. Needs about 100 bytes a
    point on top of the points (10 million: 1 GB), for ``min_samples`` of 8 and more up to 12 more.

    Args:
        min_cluster_size: smallest number of points of a cluster, 2 or more.
        min_samples: neighbours that decide the core distance; None takes ``min_cluster_size``.
        threads: threads of the neighbour searches; the result is the same for any number.
        keep_tree: keep the spanning tree in ``tree_``, 16 bytes a point.

    Attributes:
        labels_: (N,) int32, -1 for noise; clusters are numbered from 0 in the order of their first points.
        tree_weight_: sum of the spanning tree's edge weights, in the unit of the points.
        tree_: ((N - 1, 2) int32 ends, (N - 1,) float64 weights), lightest first; None unless kept.
    """

    labels_: NDArray[np.int32]
    tree_weight_: float
    tree_: tuple[NDArray[np.int32], NDArray[np.float64]] | None

    def __init__(
        self, min_cluster_size: int = 5, min_samples: int | None = None, threads: int = 2, *, keep_tree: bool = False
    ) -> None:
        self.min_cluster_size = min_cluster_size
        self.min_samples = min_samples
        self.threads = threads
        self.keep_tree = keep_tree

    def fit(self, points: ArrayLike, cancel: Cancel | None = None) -> HDBSCAN:
        """Cluster the points.

        Args:
            points: (N, 3) float32 or float64, any unit; converted from other real types.
            cancel: asked every 50 ms; what it raises stops the work and comes out here.

        Returns:
            This object, with the attributes set.

        Raises:
            TypeError: when points or parameters are no numbers.
            ValueError: when the shape is another one, a coordinate is not finite, or a parameter is too small.
            RuntimeError: when the package was installed without its C++ part.
        """
        rows: NDArray[Any] = as_rows(points)
        size = as_count(self.min_cluster_size, "min_cluster_size", least=2)
        samples = size if self.min_samples is None else as_count(self.min_samples, "min_samples")
        threads = as_count(self.threads, "threads")
        if core is None:
            raise RuntimeError(
                "l3ps-cluster was installed without its C++ part. Install a C++ compiler, then run "
                "`uv sync --reinstall-package l3ps-cluster`."
            )
        samples = max(1, min(samples, len(rows) - 1))
        labels, weight, ends, weights = core.hdbscan(
            rows, min_cluster_size=size, min_samples=samples, keep_tree=self.keep_tree, threads=threads, cancel=cancel
        )
        self.labels_, self.tree_weight_ = labels, weight
        self.tree_ = (ends, weights) if self.keep_tree else None
        return self

    def fit_predict(self, points: ArrayLike, cancel: Cancel | None = None) -> NDArray[np.int32]:
        """Cluster the points and return ``labels_``; as :meth:`fit`."""
        return self.fit(points, cancel).labels_
