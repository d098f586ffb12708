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

    Measured on simulated drives kept for tuning (seeds 21 to 24), mean gain in mIoU over the primal labels, +17.0 with
    the values below against +11.3 for the published vote; and on the real recordings, where no class may lose more
    than 2 IoU.

    Attributes:
        cell: edge in metres of a neighbourhood. 0.4 gains 17.1 and 0.6 gains 17.6, but 0.4 costs trucks of the real
            keyframe 3 IoU; what is left is where the cells' borders happen to fall.
        square: edge in metres of the ground that takes a cluster's place, a multiple of ``cell``. Squares of 1 and 2 m
            gain 0.4 less, of 6 m 0.1 more.
        level: metres of height within which ground is of one kind, below a kerb's height. 0.04 to 0.15 gain the same
            within 0.2, any height 0.8 less.
        neighbours: votes that the cluster's opinion counts for among those of a neighbourhood. 3 gains 0.3 less, 8
            0.3 more, but at 10 the real recordings lose a bus that ten points show.
        own: votes that the neighbourhood's opinion counts for beside the point's own. 5 and 20 gain the same.
        crossing: share at which a vote across the ground partition counts. 1 gains 1.0 less, 0 gains 1.9 less and
            costs cars of a real recording 8 IoU: their lowest rows pass for ground.
        favour: odds by which rare and small things are favoured. 1.5 gains 0.1 more, but costs the pedestrians of the
            real keyframe 2 IoU and the bus 4.
    """

    cell: float = 0.5
    square: float = 4.0
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
        min_cluster_size: HDBSCAN's s; 5 is the paper's best (its parameter study: 3 → 46.8, 5 → 48.1, 10 → 47.8 PQ).
        voxel: cluster centroids of cells of this edge in metres instead of points; None as published.
        voting: see :class:`Voting`.
        evidence: cameras vote with their class probabilities; False takes each primal label for one vote, as published.
        consensus: see :class:`Consensus`; None lets the cluster alone decide, as published.
        object_vote: metres between two objects of a scan that choose one class for all their points; None as published.
        unseen_ground: ground that no camera saw takes the class of the nearest labelled ground within this many metres;
            None leaves it void, as published.
        instances: ``published`` mends the ids of the images, ``geometry`` takes objects from the points.
        instance_gap: metres between two objects of a class, for ``geometry``.
    """

    name: Literal["paper", "best", "fast"]
    min_area: float = 500 / (1600 * 900)
    odometry: Odometry = Odometry()
    min_cluster_size: int = 5
    voxel: float | None = None
    voting: Voting = Voting()
    evidence: bool = False
    consensus: Consensus | None = None
    object_vote: float | None = None
    unseen_ground: float | None = None
    instances: Literal["published", "geometry"] = "published"
    instance_gap: float = 0.7

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for content keys and reports."""
        return asdict(self)


PAPER = Preset(name="paper")
"""The published rules without their defects."""
BEST = replace(
    PAPER,
    name="best",
    evidence=True,
    consensus=Consensus(),
    object_vote=0.5,
    unseen_ground=2.0,
    instances="geometry",
)
"""Objects from geometry gain 10 and more PQ over the published instance step on the recordings with box truth. On
simulated drives kept for tuning (seeds 21 to 24) mIoU gains 17.0 over primal; without the object vote 3.0 less (and 8
thing PQ), without evidence 1.2 less. A gap of 0.3 or 0.7 m between objects is as good as 0.5. Unseen ground gained 1.5
before wide squares reached most of it; a reach of 1 or 3 m was no better than 2 m."""
FAST = replace(BEST, name="fast", voxel=0.2)
"""Clusters cell centroids instead of points."""

PRESETS: dict[str, Preset] = {preset.name: preset for preset in (PAPER, BEST, FAST)}
DEFAULT_PRESET = BEST.name
