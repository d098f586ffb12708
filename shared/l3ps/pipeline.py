"""The method, scene by scene, on one page.

    images  ── segment ──▶ panoptic images ── project ──▶ primal labels        primal_labels()
    primal labels ── accumulate ▶ ground ▶ cluster ▶ vote ▶ instances ──▶ refined labels      refine_scene()

What needs the points around a point, that is cluster and vote, may go through the scene in chunks; poses, ground and
objects are those of the whole scene.

After "Label-Efficient LiDAR Panoptic Segmentation" (arXiv 2503.02372), sections III-C and III-D. Arrays in, arrays
out: no service, queue, database or terminal is known here. Progress goes through one callable, which may raise
:class:`l3ps.errors.Cancelled` between two units of work.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l3ps import project
from l3ps.costs import CostBook, StageCost
from l3ps.drivelog.types import Scan, Scene
from l3ps.errors import LabelError, Problem
from l3ps.evaluate.estimates import ScanEstimate, estimate_scene
from l3ps.labels.types import ScanLabels
from l3ps.presets import Preset
from l3ps.progress import Progress, silent
from l3ps.refine.accumulate import transform
from l3ps.refine.chunks import plan, progress_of
from l3ps.refine.cluster import Clusterer, cluster_scene
from l3ps.refine.ground import GroundSegmenter
from l3ps.refine.identify import VotedScan, identify
from l3ps.refine.poses import Motion, PoseTracker
from l3ps.refine.verdict import decide
from l3ps.segment.session import Segmenter

REFINE_STAGES = ("accumulate", "ground", "cluster", "vote", "instances")


@dataclass(frozen=True, slots=True)
class RefinedScene:
    """What refinement yields for one scene.

    Attributes:
        labels: refined labels, one a scan, in scan order.
        poses: (S, 4, 4) float64, lidar frame of each scan → frame of the first.
        costs: per stage.
        estimates: how good each scan's labels are, estimated without truth.
        motion: the poses with their source and how well the scans fit them.
    """

    labels: list[ScanLabels]
    poses: NDArray[np.float64]
    costs: dict[str, StageCost]
    estimates: list[ScanEstimate]
    motion: Motion

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What the user should know of the scene; nothing of it stopped the work."""
        return self.motion.problems


def primal_labels(scene: Scene, segmenter: Segmenter, progress: Progress = silent) -> list[ScanLabels]:
    """Labels of a scene's scans straight from the images (paper, section III-C).

    Args:
        scene: the scene; each scan's points and images are read once and let go, images a few ahead.
        segmenter: the 2D network.
        progress: told after each image.

    Returns:
        One :class:`ScanLabels` a scan; points that no camera sees are void.

    Raises:
        DriveLogError: when a scan or image cannot be read.
    """
    paths = [camera.path for scan in scene.scans for camera in scan.cameras]
    done = 0

    def views(scan: Scan) -> Iterator[project.View]:
        nonlocal done
        for camera in scan.cameras:
            yield next(images), scan.lidar_to_camera(camera), camera.intrinsic
            done += 1
            progress("segment", done, len(paths))

    with closing(segmenter.stream(paths)) as images:
        return [ScanLabels(s.token, *project.primal_labels(s.load_points().xyz, views(s))) for s in scene.scans]


def refine_scene(
    scene: Scene,
    primal: Sequence[ScanLabels],
    preset: Preset,
    *,
    sensor_height: float | None = None,
    threads: int = 2,
    progress: Progress = silent,
    clusterer: Clusterer | None = None,
    max_points: int | None = None,
) -> RefinedScene:
    """Repair primal labels by the geometry of the accumulated scene (paper, section III-D).

    Args:
        scene: the scene; a scan's points are read when they are needed, twice in all, and let go.
        primal: its primal labels in scan order.
        preset: the parameters.
        sensor_height: LiDAR above ground in metres, None where unknown.
        threads: threads of each step.
        progress: told after each scan and step.
        clusterer: implementation of HDBSCAN; None takes that of ``l3ps_cluster``.
        max_points: a scene of more points is clustered in overlapping chunks of at most so many; None sets no limit.

    Returns:
        The refined labels in point-file order.

    Raises:
        LabelError: when primal labels and scans do not belong together.
        ProcessingError: when the odometry fails.
    """
    book = CostBook()
    motion, ground = _survey(scene, primal, preset, sensor_height, book, progress)
    voted: list[VotedScan] = []
    estimates: list[ScanEstimate] = []
    chunks = plan([len(mask) for mask in ground], motion.starts, max_points)
    for index, chunk in enumerate(chunks):
        own, tell = chunk.scans, progress_of(progress, index, len(chunks))
        part = motion.part(chunk.first, chunk.stop)
        scans, judged = _vote(scene.scans[own], primal[own], ground[own], part, preset, threads, book, tell, clusterer)
        voted += scans[chunk.kept]
        estimates += judged[chunk.kept]
    with book.span("instances"):
        seconds = np.array([scan.timestamp for scan in scene.scans]) / 1e6
        labels = identify(voted, primal, motion, seconds, preset, progress)
    return RefinedScene(labels, motion.poses, book.stages, estimates, motion)


def _survey(
    scene: Scene,
    primal: Sequence[ScanLabels],
    preset: Preset,
    sensor_height: float | None,
    book: CostBook,
    progress: Progress,
) -> tuple[Motion, list[NDArray[np.bool_]]]:
    """What takes a scene's scans in order and one at a time: their poses and, a scan, (N,) bool which are ground."""
    _check_tokens(scene.scans, primal)
    tracker = PoseTracker(scene, preset)
    split = GroundSegmenter(sensor_height)
    ground: list[NDArray[np.bool_]] = []
    for done, (scan, labels) in enumerate(zip(scene.scans, primal, strict=True), start=1):
        with book.span("accumulate"):
            cloud = scan.load_points()
            _check_length(len(cloud), labels)
            tracker.add(cloud)
        progress("accumulate", done, len(scene.scans))
        with book.span("ground"):
            ground.append(split(cloud.xyz, cloud.intensity))
        progress("ground", done, len(scene.scans))
    return tracker.motion(), ground


def _vote(
    scans: Sequence[Scan],
    primal: Sequence[ScanLabels],
    grounds: Sequence[NDArray[np.bool_]],
    motion: Motion,
    preset: Preset,
    threads: int,
    book: CostBook,
    progress: Progress,
    clusterer: Clusterer | None,
) -> tuple[list[VotedScan], list[ScanEstimate]]:
    """Classes of scans that are laid over each other in one frame, and how good they seem."""
    bounds = np.cumsum([0, *map(len, grounds)])

    with book.span("accumulate"):
        points = np.empty((bounds[-1], 3), dtype=np.float32)
        for index, scan in enumerate(scans):
            points[bounds[index] : bounds[index + 1]] = transform(scan.load_points().xyz, motion.poses[index])
        ground = np.concatenate(grounds)

    with book.span("cluster"):
        cluster, noise = cluster_scene(
            points,
            ground,
            preset.min_cluster_size,
            threads=threads,
            voxel=preset.voxel,
            clusterer=clusterer,
            cancel=lambda: progress("cluster", 0, 1),
        )
        progress("cluster", 1, 1)

    with book.span("vote"):
        verdict = decide(points, ground, cluster, noise, primal, preset)
        voted = [
            VotedScan.of(scan.token, points[own], ground[own], verdict.of(own))
            for scan, own in zip(scans, map(slice, bounds[:-1], bounds[1:]), strict=True)
        ]
        progress("vote", 1, 1)

    return voted, estimate_scene(points, cluster, primal, verdict.semantic, verdict.confidence)


_REMEDY = "Use the primal labels that were made from this log."


def _check_tokens(scans: Sequence[Scan], primal: Sequence[ScanLabels]) -> None:
    if [scan.token for scan in scans] != [labels.token for labels in primal]:
        raise LabelError(Problem("labels-of-other-scans", "primal labels", "they name other scans", _REMEDY))


def _check_length(points: int, labels: ScanLabels) -> None:
    if len(labels.semantic) != points:
        what = f"{len(labels.semantic)} labels for {points} points"
        raise LabelError(Problem("labels-of-other-length", labels.token, what, _REMEDY))
