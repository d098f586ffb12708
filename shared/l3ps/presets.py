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
class Preset:
    """Everything that decides the labels of a drive besides the model.

    Attributes:
        name: how the user asks for it.
        min_area: smallest image object, as a share of the image; published as 500 px of 1600×900.
        odometry: see :class:`Odometry`.
        min_cluster_size: HDBSCAN's s; 5 is the paper's best (its parameter study: 3 → 46.8, 5 → 48.1, 10 → 47.8 PQ).
        voxel: cluster centroids of cells of this edge in metres instead of points; None as published.
        voting: see :class:`Voting`.
        unseen_ground: ground that no camera saw takes the class of the nearest labelled ground within this many metres;
            None leaves it void, as published.
        instances: ``published`` mends the ids of the images, ``geometry`` takes objects from the points of a scan,
            ``scene`` from those of all scans: one id and one class an object throughout (:mod:`l3ps.refine.objects`).
        instance_gap: metres between two objects of a class, for ``geometry``.
        instance_class: the points of an object take the class that most of them, over all scans, vote for and that fits
            its size; for ``scene``.
    """

    name: Literal["paper", "best", "fast"]
    min_area: float = 500 / (1600 * 900)
    odometry: Odometry = Odometry()
    min_cluster_size: int = 5
    voxel: float | None = None
    voting: Voting = Voting()
    unseen_ground: float | None = None
    instances: Literal["published", "geometry", "scene"] = "published"
    instance_gap: float = 0.7
    instance_class: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for content keys and reports."""
        return asdict(self)


PAPER = Preset(name="paper")
"""The published rules without their defects."""
BEST = replace(PAPER, name="best", unseen_ground=2.0, instances="scene", instance_class=True)
"""Objects of the scene gain 10 and more PQ over the published instance step on each recording with box truth: 32.2, 8.0
and 29.3 become 46.1, 27.2 and 41.5 for things. Unseen ground gains 2.2, 1.4 and 1.0 mIoU on simulated drives kept for
tuning (seeds 21, 22, 23); a reach of 1 m gains 1.6, 1.7 and 1.0, one of 3 m no more than 2 m."""
FAST = replace(BEST, name="fast", voxel=0.2)
"""Clusters cell centroids instead of points."""

PRESETS: dict[str, Preset] = {preset.name: preset for preset in (PAPER, BEST, FAST)}
DEFAULT_PRESET = BEST.name
