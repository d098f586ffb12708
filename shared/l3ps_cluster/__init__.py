"""Clusters of 3D points: exact HDBSCAN, nearest neighbours and single linkage, in C++ under arrays.

    HDBSCAN(min_cluster_size=5).fit_predict(points)     (N,) label, -1 for noise
    nearest(points, queries, k)                         distances and indices
    link(points, gap)                                   components of points that a chain of steps ≤ gap connects
    fill_noise(points, labels)                          noise takes the majority label of its nearest

Every call lets go of the interpreter's lock, gives the same result for any number of threads, and asks ``cancel`` every
50 ms: when that raises, the work stops and the exception goes on.

Where no C++ compiler was there on installation, ``native`` is False: ``HDBSCAN`` then raises RuntimeError, and the
three functions run on SciPy. To build it after the fact: ``uv sync --reinstall-package l3ps-cluster``.
"""

from l3ps_cluster.hdbscan import HDBSCAN
from l3ps_cluster.neighbours import fill_noise, link, nearest
from l3ps_cluster.points import build, native

__all__ = ["HDBSCAN", "build", "fill_noise", "link", "native", "nearest"]
