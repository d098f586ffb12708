"""One class a cluster (paper, section III-D, step 4; METHOD 3.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l3ps.presets import Voting
from l3ps.refine.cluster import NOISE
from l3ps.taxonomy import NUSCENES16, VOID


def vote(cluster: NDArray[np.int32], semantic: NDArray[np.uint8], voting: Voting) -> NDArray[np.uint8]:
    """Give every point of a cluster the class its points vote for.

    Shares are over all points of the cluster, void included. If void is the most frequent: all void where its share
    exceeds ``tau_void``, else the most frequent other class. Else the first rare class, in the published order, with
    a share above ``tau_rare``. Else the most frequent class.

    Args:
        cluster: (N,) int32 ids from 0, -1 for points of no cluster, which keep their class.
        semantic: (N,) uint8 primal class.
        voting: the thresholds.

    Returns:
        (N,) uint8 refined class.
    """
    member = cluster != NOISE
    if not member.any():
        return semantic.copy()
    winner = winners(count_votes(cluster[member], semantic[member]), voting)
    refined = semantic.copy()
    refined[member] = winner[cluster[member]]
    return refined


def count_votes(cluster: NDArray[np.int32], semantic: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(K, C) int64: points of each class in each cluster."""
    classes = len(NUSCENES16.classes)
    number = int(cluster.max()) + 1
    flat = cluster.astype(np.int64) * classes + semantic
    return np.bincount(flat, minlength=number * classes).reshape(number, classes)


def winners(counts: NDArray[np.int64], voting: Voting) -> NDArray[np.uint8]:
    """(K,) uint8 class that wins each row of ``counts`` (K, C)."""
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    winner = counts.argmax(axis=1)
    void = winner == VOID
    other = counts[:, VOID + 1 :].argmax(axis=1) + VOID + 1
    mostly_void = share[:, VOID] > voting.tau_void
    winner = np.where(void, np.where(mostly_void, VOID, other), winner)
    open_to_rare = ~void
    for rare in NUSCENES16.rare:
        hit = open_to_rare & (share[:, rare] > voting.tau_rare)
        winner[hit] = rare
        open_to_rare &= ~hit
    return winner.astype(np.uint8)
