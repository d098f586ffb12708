"""The classes of a scene by a preset's rules, how sure they are, and where each comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import Evidence, Provenance, ScanLabels
from l3ps.presets import Preset
from l3ps.refine.confidence import as_confidence, cluster_share
from l3ps.refine.consensus import by_consensus
from l3ps.refine.vote import vote
from l3ps.taxonomy import NUSCENES16, VOID


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is known of each point of a scene after the vote.

    Attributes:
        semantic: (N,) uint8 class.
        confidence: (N,) uint8, 255 = certain: estimated probability that the class is right; 0 where it is void.
        provenance: (N,) uint8, a :class:`~l3ps.labels.types.Provenance` a point.
    """

    semantic: NDArray[np.uint8]
    confidence: NDArray[np.uint8]
    provenance: NDArray[np.uint8]

    def of(self, points: slice | NDArray[np.intp]) -> Verdict:
        """The verdict on some of the points."""
        return Verdict(self.semantic[points], self.confidence[points], self.provenance[points])

    def but(self, points: NDArray[np.intp], other: Verdict) -> Verdict:
        """This verdict, with another one on some of the points."""
        changed = Verdict(self.semantic.copy(), self.confidence.copy(), self.provenance.copy())
        changed.semantic[points] = other.semantic
        changed.confidence[points] = other.confidence
        changed.provenance[points] = other.provenance
        return changed

    @classmethod
    def joined(cls, parts: Sequence[Verdict]) -> Verdict:
        """The verdicts on several sets of points, one after the other."""
        return cls(
            np.concatenate([part.semantic for part in parts]),
            np.concatenate([part.confidence for part in parts]),
            np.concatenate([part.provenance for part in parts]),
        )


def decide(
    points: NDArray[np.float32],
    ground: NDArray[np.bool_],
    cluster: NDArray[np.int32],
    noise: NDArray[np.bool_],
    primal: Sequence[ScanLabels],
    preset: Preset,
) -> Verdict:
    """Choose the class of every point of a scene.

    Args:
        points: (N, 3) float32, metres, scene frame, z up.
        ground: (N,) bool partition.
        cluster: (N,) int32 ids from 0, -1 for points of no cluster.
        noise: (N,) bool, points that HDBSCAN left out and that were given to a cluster afterwards.
        primal: the primal labels, scan by scan.
        preset: which rules.

    Returns:
        The verdict on each point.
    """
    before = np.concatenate([labels.semantic for labels in primal]) if primal else np.zeros(0, dtype=np.uint8)
    if preset.consensus is None:
        semantic = vote(cluster, before, preset.voting)
        share = cluster_share(cluster, before, semantic)
        provenance = np.where(semantic == before, Provenance.CAMERA, Provenance.CLUSTER).astype(np.uint8)
    else:
        opinion = by_consensus(points, ground, cluster, _evidence(primal, preset.evidence), preset.consensus)
        semantic, share = opinion.semantic, opinion.share
        wider = np.where(ground, Provenance.GROUND_RULE, Provenance.CLUSTER)
        provenance = np.where(opinion.heard, Provenance.NEIGHBOURS, wider).astype(np.uint8)
        provenance[semantic == before] = Provenance.CAMERA
        ruled_out = (before != VOID) & (NUSCENES16.is_ground[before] != ground)
        provenance[ruled_out & (semantic != before)] = Provenance.GROUND_RULE
    provenance[noise & (provenance == Provenance.CLUSTER)] = Provenance.NOISE_FILL
    provenance[semantic == VOID] = Provenance.NONE
    return Verdict(semantic, as_confidence(share, semantic), provenance)


def of_objects(verdict: Verdict, semantic: NDArray[np.uint8], instance: NDArray[np.int32]) -> Verdict:
    """The verdict after the objects had their say.

    A point whose class its object changed is as sure as the object is of one mind: its confidence becomes the share of
    the object's points, in all scans, that had this class before.

    Args:
        verdict: on each point after the vote.
        semantic: (N,) uint8 class that its object gives each point.
        instance: (N,) int32 object, 0 for none.
    """
    changed = np.flatnonzero(semantic != verdict.semantic)
    if len(changed) == 0:
        return verdict
    points = np.bincount(instance)
    agreeing = np.bincount(instance, weights=semantic == verdict.semantic)
    confidence, provenance = verdict.confidence.copy(), verdict.provenance.copy()
    share = (agreeing / np.maximum(points, 1))[instance[changed]]
    confidence[changed] = as_confidence(share.astype(np.float32), semantic[changed])
    provenance[changed] = Provenance.INSTANCE_RULE
    return Verdict(semantic, confidence, provenance)


def _evidence(primal: Sequence[ScanLabels], wanted: bool) -> Evidence:
    """The evidence of all scans; where there is none, each label is one vote."""
    parts = [
        labels.evidence if wanted and labels.evidence is not None else Evidence.of_labels(labels.semantic)
        for labels in primal
    ]
    if not parts:
        return Evidence.of_labels(np.zeros(0, dtype=np.uint8))
    return Evidence(
        np.concatenate([part.classes for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.cameras for part in parts]),
        np.concatenate([part.agree for part in parts]),
    )
