"""The method, scene by scene, on one page.

    images  ── segment ──▶ panoptic images ── project ──▶ primal labels        primal_labels()
    primal labels ── accumulate ▶ ground ▶ cluster ▶ vote ▶ instances ──▶ refined labels      refine_scene()

After "Label-Efficient LiDAR Panoptic Segmentation" (arXiv 2503.02372), sections III-C and III-D. Arrays in, arrays
out: no service, queue, database or terminal is known here. Progress goes through one callable, which may raise
:class:`l3ps.errors.Cancelled` between two units of work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps import project
from l3ps.costs import CostBook, StageCost
from l3ps.drivelog.types import Scan, Scene
from l3ps.errors import LabelError, Problem
from l3ps.labels.types import ScanLabels
from l3ps.presets import Preset
from l3ps.progress import Progress, silent, track
from l3ps.refine.accumulate import estimate_poses, transform
from l3ps.refine.cluster import Clusterer, cluster_scene, hdbscan_package
from l3ps.refine.ground import GroundSegmenter
from l3ps.refine.instances import correct_instances, geometric_instances
from l3ps.refine.objects import scene_instances
from l3ps.refine.vote import fill_unseen_ground, vote
from l3ps.segment.images import read_rgb
from l3ps.segment.session import Segmenter

REFINE_STAGES = ("accumulate", "ground", "cluster", "vote", "instances")


@dataclass(frozen=True, slots=True)
class RefinedScene:
    """What refinement yields for one scene.

    Attributes:
        labels: refined labels, one a scan, in scan order.
        poses: (S, 4, 4) float64, lidar frame of each scan → frame of the first.
        costs: per stage.
    """

    labels: list[ScanLabels]
    poses: NDArray[np.float64]
    costs: dict[str, StageCost]


def primal_labels(scene: Scene, segmenter: Segmenter, progress: Progress = silent) -> list[ScanLabels]:
    """Labels of a scene's scans straight from the images (paper, section III-C).

    Args:
        scene: the scene; each scan's points and images are read once and let go.
        segmenter: the 2D network.
        progress: told after each image.

    Returns:
        One :class:`ScanLabels` a scan; points that no camera sees are void.

    Raises:
        DriveLogError: when a scan or image cannot be read.
    """
    total = sum(len(scan.cameras) for scan in scene.scans)
    done = 0
    labels: list[ScanLabels] = []
    for scan in scene.scans:
        views = []
        for camera in scan.cameras:
            views.append((segmenter.segment(read_rgb(camera.path)), scan.lidar_to_camera(camera), camera.intrinsic))
            done += 1
            progress("segment", done, total)
        labels.append(ScanLabels(scan.token, *project.primal_labels(scan.load_points().xyz, views)))
    return labels


def refine_scene(
    scene: Scene,
    primal: Sequence[ScanLabels],
    preset: Preset,
    *,
    sensor_height: float | None = None,
    threads: int = 2,
    progress: Progress = silent,
    clusterer: Clusterer = hdbscan_package,
) -> RefinedScene:
    """Repair primal labels by the geometry of the accumulated scene (paper, section III-D).

    Args:
        scene: the scene.
        primal: its primal labels in scan order.
        preset: the parameters.
        sensor_height: LiDAR above ground in metres, None where unknown.
        threads: threads of each step.
        progress: told after each scan and step.
        clusterer: implementation of HDBSCAN.

    Returns:
        The refined labels in point-file order.

    Raises:
        LabelError: when primal labels and scans do not belong together.
        ProcessingError: when the odometry fails.
    """
    book = CostBook()

    with book.span("accumulate"):
        clouds = [scan.load_points() for scan in scene.scans]
        _check_match(scene.scans, [len(cloud) for cloud in clouds], primal)
        ticked = track(clouds, "accumulate", progress)
        poses = estimate_poses((cloud.xyz for cloud in ticked), preset.odometry)
        points = np.concatenate([transform(c.xyz, pose) for c, pose in zip(clouds, poses, strict=True)])

    with book.span("ground"):
        split = GroundSegmenter(sensor_height)
        ground = np.concatenate([split(c.xyz, c.intensity) for c in track(clouds, "ground", progress)])

    with book.span("cluster"):
        cluster = cluster_scene(
            points, ground, preset.min_cluster_size, threads=threads, voxel=preset.voxel, clusterer=clusterer
        )
        progress("cluster", 1, 1)

    with book.span("vote"):
        semantic = vote(cluster, np.concatenate([labels.semantic for labels in primal]), preset.voting)
        if preset.unseen_ground is not None:
            semantic = fill_unseen_ground(points, ground, semantic, preset.unseen_ground, threads)
        progress("vote", 1, 1)

    with book.span("instances"):
        bounds = np.cumsum([0, *(len(cloud) for cloud in clouds)])
        scene_ids: NDArray[np.int32] | None = None
        if preset.instances == "scene":
            scene_ids, semantic = scene_instances(
                points,
                bounds,
                ground,
                semantic,
                np.concatenate([labels.semantic for labels in primal]),
                poses[:, :3, 3],
                np.array([scan.timestamp for scan in scene.scans]) / 1e6,
                one_class=preset.instance_class,
            )
        refined: list[ScanLabels] = []
        for index, before in enumerate(track(primal, "instances", progress)):
            part = slice(bounds[index], bounds[index + 1])
            if scene_ids is not None:
                ids = scene_ids[part]
            elif preset.instances == "published":
                ids = correct_instances(points[part], before.semantic, before.instance, semantic[part])
            else:
                ids = geometric_instances(points[part], semantic[part], preset.instance_gap)
            refined.append(ScanLabels(before.token, semantic[part], ids))

    return RefinedScene(refined, poses, book.stages)


def _check_match(scans: Sequence[Scan], sizes: Sequence[int], primal: Sequence[ScanLabels]) -> None:
    remedy = "Use the primal labels that were made from this log."
    if [scan.token for scan in scans] != [labels.token for labels in primal]:
        raise LabelError(Problem("labels-of-other-scans", "primal labels", "they name other scans", remedy))
    for size, labels in zip(sizes, primal, strict=True):
        if len(labels.semantic) != size:
            what = f"{len(labels.semantic)} labels for {size} points"
            raise LabelError(Problem("labels-of-other-length", labels.token, what, remedy))
