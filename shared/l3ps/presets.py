"""Named sets of parameters, each with the source of its values."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Odometry:
    """KISS-ICP's constants; the defaults are those of the published implementation."""

    max_range: float = 80.0
    min_range: float = 5.0
    voxel_size: float = 0.8
    max_points_per_voxel: int = 20
    initial_threshold: float = 60.0
    min_motion: float = 0.8


@dataclass(frozen=True, slots=True)
class Voting:
    """Thresholds of the cluster vote; the defaults are the published ones.

    Attributes:
        tau_void: a cluster whose most frequent class is void stays void above this share.
        tau_rare: a rare class wins above this share.
    """

    tau_void: float = 0.9
    tau_rare: float = 0.3


@dataclass(frozen=True, slots=True)
class Consensus:
    """How point, neighbourhood and cluster agree on a class (see :mod:`l3ps.refine.consensus`).

    Measured on simulated drives kept for tuning (seeds 21 to 24), mean gain in mIoU over the primal labels, +17.7 with
    the values below against +11.3 for the published vote; and on the real recordings, where no class may lose more
    than 2 IoU and the largest loss is 0.5. Gains differ by 0.5 with where the borders of cells happen to fall.

    Attributes:
        cell: edge in metres of a neighbourhood. 0.4 to 0.7 gain 17.4 to 18.3 in no order; below 0.5 trucks or
            pedestrians of the real keyframe lose 3 IoU.
        square: edge in metres of the ground that takes a cluster's place, a multiple of ``cell``. 1 gains 17.3, 2 17.6,
            4 and 6 gain 18.0, but there cars of a real recording lose 1.6 to the ground they stand on.
        level: metres of height within which ground is of one kind, below a kerb's height. 0.04 to 0.15 gain 17.0 to
            17.4, any height 17.2; with squares of 4 m 17.9 to 18.0, and any height 17.0.
        neighbours: votes that the cluster's opinion counts for among those of a neighbourhood. 3 gains 17.2, 10 gains
            18.0, but there the real recordings lose a bus that ten points show.
        own: votes that the neighbourhood's opinion counts for beside the point's own. 5 to 20 gain the same.
        crossing: share at which a vote across the ground partition counts. 1 gains 16.8, 0 gains 15.4 and costs cars
            of a real recording 8 IoU: their lowest rows pass for ground.
        favour: odds by which rare and small things and the sidewalk are favoured. 1 gains 16.7, 1.5 17.4, 3 17.6; below
            2 the real recordings lose the bus and pedestrians.
    """

    cell: float = 0.5
    square: float = 3.0
    level: float = 0.08
    neighbours: float = 5.0
    own: float = 10.0
    crossing: float = 0.35
    favour: float = 2.0


@dataclass(frozen=True, slots=True)
class Preset:
    """Everything that decides the labels of a drive besides the model.

    Attributes:
        name: how the user asks for it.
        min_area: smallest image object, as a share of the image; published as 500 px of 1600×900.
        odometry: see :class:`Odometry`.
        poses: ``kiss-icp`` as published, unchecked; ``log`` takes the log's own where the scans agree with them, else
            KISS-ICP's, and cuts the scene where neither can be trusted (:mod:`l3ps.refine.poses`).
        min_cluster_size: HDBSCAN's s; 5 is the paper's best (its parameter study: 3 → 46.8, 5 → 48.1, 10 → 47.8 PQ).
        voxel: cluster centroids of cells of this edge in metres instead of points; None as published.
        voting: see :class:`Voting`.
        evidence: cameras vote with their class probabilities; False takes each primal label for one vote, as published.
        consensus: see :class:`Consensus`; None lets the cluster alone decide, as published.
        instances: ``published`` mends the ids of the images, ``scene`` takes objects from the points of all scans: one
            id and one class an object throughout (:mod:`l3ps.refine.objects`).
        instance_class: the points of an object take the class that most of them, over all scans, vote for and that fits
            its size; for ``scene``.
    """

    name: Literal["paper", "best", "fast"]
    min_area: float = 500 / (1600 * 900)
    odometry: Odometry = Odometry()
    poses: Literal["kiss-icp", "log"] = "kiss-icp"
    min_cluster_size: int = 5
    voxel: float | None = None
    voting: Voting = Voting()
    evidence: bool = False
    consensus: Consensus | None = None
    instances: Literal["published", "scene"] = "published"
    instance_class: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for content keys and reports."""
        return asdict(self)


PAPER = Preset(name="paper")
"""The published rules without their defects."""
BEST = replace(
    PAPER,
    name="best",
    poses="log",
    evidence=True,
    consensus=Consensus(),
    instances="scene",
    instance_class=True,
)
"""Every part measured: docs/refinement.md. The defaults of :class:`Consensus` are its values."""
FAST = replace(BEST, name="fast", voxel=0.2)
"""Clusters cell centroids instead of points."""

PRESETS: dict[str, Preset] = {preset.name: preset for preset in (PAPER, BEST, FAST)}
DEFAULT_PRESET = BEST.name
