"""The instance ids of a scene by a preset's rule (paper, section III-D, step 5).

Objects are told apart once for the whole scene, however many chunks it was voted in: that takes the thing points alone,
a small part of all. Only where the poses tear are there parts, each with objects of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from l3ps.labels.types import ScanLabels
from l3ps.presets import Preset
from l3ps.progress import Progress, silent, track
from l3ps.refine.instances import correct_instances
from l3ps.refine.objects import scene_instances
from l3ps.refine.poses import Motion
from l3ps.refine.tracks import Advance
from l3ps.refine.verdict import Verdict, of_objects
from l3ps.taxonomy import NUSCENES16

_FLOOR = 4
"""One ground point in so many is kept, enough to know how high the road lies."""


@dataclass(frozen=True, slots=True)
class VotedScan:
    """What telling objects apart takes of a scan after the vote, so that its other points can be let go.

    Attributes:
        token: the scan's token.
        verdict: on each point.
        things: (T, 3) float32 the points whose class is a thing, in order, metres, scene frame.
        floor: (G, 3) float32 some of the ground's points, likewise.
    """

    token: str
    verdict: Verdict
    things: NDArray[np.float32]
    floor: NDArray[np.float32]

    @classmethod
    def of(cls, token: str, points: NDArray[np.float32], ground: NDArray[np.bool_], verdict: Verdict) -> VotedScan:
        """Keep what is needed.

        Args:
            token: the scan's token.
            points: (N, 3) float32, metres, scene frame, z up.
            ground: (N,) bool partition.
            verdict: on each point.
        """
        return cls(token, verdict, points[_things(verdict)], points[np.flatnonzero(ground)[::_FLOOR]])

    def labels(self, instance: NDArray[np.int32], settled: Verdict | None = None) -> ScanLabels:
        """The scan's labels.

        Args:
            instance: (T,) int32 id of each thing point.
            settled: on each thing point, where it is not that of the vote.
        """
        members = _things(self.verdict)
        ids = np.zeros(len(self.verdict.semantic), dtype=np.int32)
        ids[members] = instance
        told = self.verdict if settled is None else self.verdict.but(members, settled)
        return ScanLabels(self.token, told.semantic, ids, confidence=told.confidence, provenance=told.provenance)


def identify(
    scans: Sequence[VotedScan],
    primal: Sequence[ScanLabels],
    motion: Motion,
    seconds: NDArray[np.float64],
    preset: Preset,
    progress: Progress = silent,
) -> list[ScanLabels]:
    """Tell the objects of a scene apart.

    Args:
        scans: all of the scene.
        primal: their primal labels.
        motion: through the scene; objects end where it is cut.
        seconds: (S,) float64 time of each scan.
        preset: which rule: that of the paper gives ids that hold within a scan, objects of the scene ids that hold
            throughout.
        progress: told of each scan.

    Returns:
        The refined labels, scan by scan.
    """
    if preset.instances == "published":
        pairs = zip(track(scans, "instances", progress), primal, strict=True)
        return [scan.labels(_corrected(scan, before)) for scan, before in pairs]
    refined: list[ScanLabels] = []
    taken = 0
    for first, stop in pairwise([*motion.starts, len(scans)]):
        part = slice(first, stop)
        tell = functools.partial(_tell, progress, first, len(scans))
        refined += _with_objects(scans[part], primal[part], motion.poses[part], seconds[part], preset, taken, tell)
        taken = max([taken, *(int(labels.instance.max(initial=0)) for labels in refined[part])])
        tell(stop - first)
    return refined


def _tell(progress: Progress, first: int, total: int, done: int) -> None:
    progress("instances", first + done, total)


def _corrected(scan: VotedScan, before: ScanLabels) -> NDArray[np.int32]:
    """(T,) int32 ids of one scan's things as published; it looks at no other point's place."""
    things = _things(scan.verdict)
    xyz = np.zeros((len(before.semantic), 3), dtype=np.float32)
    xyz[things] = scan.things
    return correct_instances(xyz, before.semantic, before.instance, scan.verdict.semantic)[things]


def _with_objects(
    scans: Sequence[VotedScan],
    primal: Sequence[ScanLabels],
    poses: NDArray[np.float64],
    seconds: NDArray[np.float64],
    preset: Preset,
    taken: int,
    advance: Advance,
) -> list[ScanLabels]:
    """Labels of scans of one frame with their objects' classes and ids, which are counted on from ``taken``."""
    if not scans:
        return []
    members = [_things(scan.verdict) for scan in scans]
    bounds = np.cumsum([0, *map(len, members)])
    verdict = Verdict.joined([scan.verdict.of(own) for scan, own in zip(scans, members, strict=True)])
    instance, semantic = scene_instances(
        np.concatenate([scan.things for scan in scans]),
        bounds,
        np.concatenate([scan.floor for scan in scans]),
        verdict.semantic,
        np.concatenate([_seen(labels, preset.evidence)[own] for labels, own in zip(primal, members, strict=True)]),
        poses[:, :3, 3],
        seconds,
        one_class=preset.instance_class,
        advance=advance,
    )
    settled = of_objects(verdict, semantic, instance)
    instance[instance > 0] += taken
    parts = map(slice, bounds[:-1], bounds[1:])
    return [scan.labels(instance[own], settled.of(own)) for scan, own in zip(scans, parts, strict=True)]


def _seen(labels: ScanLabels, wanted: bool) -> NDArray[np.uint8]:
    """(N,) uint8 class that the cameras saw at each point, before an image's objects made their pixels of one mind.

    An object of the scene is given its class by its points of all scans. Errors of whole image objects are alike in
    many of them: with the labels' own classes here refined labels lose 4 PQ on a simulated drive.
    """
    if not wanted or labels.evidence is None:
        return labels.semantic
    heard = labels.evidence.weights[:, 0] > 0
    return np.where(heard, labels.evidence.classes[:, 0], labels.semantic)


def _things(verdict: Verdict) -> NDArray[np.intp]:
    return np.flatnonzero(NUSCENES16.is_thing[verdict.semantic])
