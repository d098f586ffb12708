"""Where the LiDAR was at each scan of a scene: the log's own poses or KISS-ICP's, whichever the scans agree with.

Neither is believed unseen. Of each pair of neighbouring scans it is measured how well they lie on each other under
either motion (:mod:`l3ps.refine.overlap`, 3 ms a scan); the log's poses are taken unless they are clearly worse, a
single wrong step of one source is replaced by the other's, and where both are lost the scene is cut, to be refined in
parts rather than smeared.

KISS-ICP predicts that a scan moves as the last one did, which it cannot know of the second scan. At 2 Hz the true
motion is then out of its reach: on simulated drives it stood still for a whole scene (0.21 of the points met instead
of 0.52). So the prediction is chosen by measurement too: the last motion, the log's, none, or the best of a coarse
search.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Points, Scene
from l3ps.errors import Problem
from l3ps.geometry import Matrix, invert, is_rigid
from l3ps.presets import Preset
from l3ps.refine.accumulate import Odometer
from l3ps.refine.overlap import Fit, Standing, fit, search, standing

WORSE, SLACK = 1.1, 0.005
"""The log's poses are clearly worse when their median residual exceeds that of KISS-ICP by this factor and this many
metres. True poses of simulated drives exceed it by up to 5 %, as registration makes small what is measured here;
those of a SemanticKITTI sequence by 20 %."""
LOST = 0.25
"""Overlap below which KISS-ICP's step is taken to be wrong. Right steps of the recordings have 0.53 and more, of
simulated drives at 2 Hz 0.28 and more; a step that is 3 m or 3 degrees wrong has 0.03 to 0.31."""
LOST_LOG = 0.15
"""The same for the log's step, which comes from other sensors and is doubted less."""
STEP_GAIN = 0.1
"""A step of the other source replaces one of the chosen source when its overlap is larger by more than this."""
SAME = 0.5
"""Metres: steps of both sources nearer than this confirm each other, whatever the overlap."""

Source = Literal["log", "kiss-icp"]


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion of the LiDAR through a scene.

    Attributes:
        poses: (S, 4, 4) float64 lidar → frame of the first scan; between two parts their relation is a guess.
        source: whose poses they are, but for single steps that ``problems`` name.
        starts: first scan of each part that hangs together, ascending, 0 first.
        residual: (S,) float64 metres between a scan and the one before it, see :class:`~l3ps.refine.overlap.Fit`; NaN
            where it cannot be told and for the first.
        overlap: (S,) float64 share, likewise.
        problems: what is wrong with the poses; all are warnings.
    """

    poses: NDArray[np.float64]
    source: Source
    starts: tuple[int, ...]
    residual: NDArray[np.float64]
    overlap: NDArray[np.float64]
    problems: tuple[Problem, ...] = ()

    def part(self, first: int, stop: int) -> Motion:
        """The motion through some consecutive scans, in the same frame; problems stay with the whole."""
        own = slice(first, stop)
        return Motion(self.poses[own], self.source, (0,), self.residual[own], self.overlap[own])


class PoseTracker:
    """Takes the scans of one scene in order and then tells the :class:`Motion`.

    Args:
        scene: the scene; its points are not read here.
        preset: ``poses`` and ``odometry`` decide.
    """

    def __init__(self, scene: Scene, preset: Preset) -> None:
        self._scene, self._preset = scene, preset
        self._odometer = Odometer(preset.odometry)
        self._log = log_steps(scene) if preset.poses == "log" else None
        self._last: Standing | None = None
        self._steps: dict[str, list[Matrix]] = {"kiss-icp": [], "log": []}
        self._fits: dict[str, list[Fit]] = {"kiss-icp": [], "log": []}
        self._poses: list[Matrix] = []
        self._moving = False  # whether the last motion tells the next

    def add(self, points: Points) -> None:
        """Register the next scan.

        Raises:
            ProcessingError: when the scan has no point in range or the odometry diverges.
        """
        checked = self._preset.poses == "log"
        xyz = points.xyz
        here, before = standing(xyz), self._last
        self._last = here
        if before is None:
            self._poses.append(self._odometer(xyz))
            return
        log = None if self._log is None else self._log[len(self._poses) - 1]
        if checked:
            last = self._odometer.step if self._moving else None
            self._odometer.predict(_predicted(before, here, last, log))
        self._poses.append(self._odometer(xyz))
        step = self._odometer.step
        own = fit(before, here, step)
        self._steps["kiss-icp"].append(step)
        self._fits["kiss-icp"].append(own)
        if log is not None:
            self._steps["log"].append(log)
            self._fits["log"].append(fit(before, here, log))
        lost = checked and own.overlap < LOST
        if lost:
            self._odometer.restart(xyz)  # the map behind is of another place than the scan's pose says
        self._moving = not lost

    def motion(self) -> Motion:
        """The motion through the scans added so far."""
        own = _Steps.of(self._steps["kiss-icp"], self._fits["kiss-icp"], LOST)
        if self._log is None:
            return self._told("kiss-icp", own, None, [])
        log = _Steps.of(self._steps["log"], self._fits["log"], LOST_LOG)
        both = np.isfinite(own.residual) & np.isfinite(log.residual) & ~own.lost
        ours, theirs = (float(np.median(s.residual[both])) if both.any() else np.nan for s in (own, log))
        if theirs > WORSE * ours + SLACK:
            what = f"neighbouring scans lie {theirs:.2f} m apart under the log's poses, {ours:.2f} m under KISS-ICP's"
            remedy = "KISS-ICP's were used; check the ego poses and the LiDAR's extrinsic."
            return self._told("kiss-icp", own, log, [self._warning("inconsistent-poses", what, remedy)])
        return self._told("log", log, own, [])

    def _told(self, source: Source, chosen: _Steps, other: _Steps | None, problems: list[Problem]) -> Motion:
        """The motion by the steps of one source, mended by those of the other."""
        lost, steps = chosen.lost, chosen.step.copy()
        residual, overlap = chosen.residual.copy(), chosen.overlap.copy()
        if other is not None:
            same = np.linalg.norm(chosen.step[:, :3, 3] - other.step[:, :3, 3], axis=1) < SAME
            better = ~same & ~other.lost & (lost | (other.overlap > overlap + STEP_GAIN))
            lost &= ~(better | same)
            for values, others in ((steps, other.step), (residual, other.residual), (overlap, other.overlap)):
                values[better] = others[better]
            for pair in np.flatnonzero(better):
                what = f"{_NAMES[source]} move {_moved(chosen.step[pair])}, but the scans fit {_moved(steps[pair])}"
                problems.append(self._warning("pose-jump", what, "The motion that fits was used.", int(pair) + 1))
        starts = [0]
        for pair in np.flatnonzero(lost):
            share = f"{100 * overlap[pair]:.0f} %"
            what = f"it cannot be laid onto the scan before it: only {share} of what stands there meets something"
            remedy = "Give the log's ego poses, or leave scans of another place out."
            if self._preset.poses == "log":
                starts.append(int(pair) + 1)
                remedy = f"The scene was refined in parts, cut before this scan. {remedy}"
            problems.append(self._warning("odometry-failed", what, remedy, int(pair) + 1))
        published = self._preset.poses == "kiss-icp"  # the product of its steps differs in the last digit
        poses = np.array(self._poses).reshape(-1, 4, 4) if published else _chained(steps)[: len(self._poses)]
        return Motion(
            poses,
            source,
            tuple(starts),
            np.concatenate([[np.nan], residual])[: len(self._poses)],
            np.concatenate([[np.nan], overlap])[: len(self._poses)],
            tuple(problems),
        )

    def _warning(self, code: str, what: str, remedy: str, scan: int | None = None) -> Problem:
        where, token = self._scene.name, None
        if scan is not None:
            token = self._scene.scans[scan].token
            where = f"{where}, scan {scan}"
        return Problem(code, where, what, remedy, "warning", self._scene.name, token)


_NAMES: dict[Source, str] = {"log": "the log's poses", "kiss-icp": "KISS-ICP's poses"}


@dataclass(frozen=True, slots=True)
class _Steps:
    """The motions of one source from scan to scan: (S - 1, …) each."""

    step: NDArray[np.float64]
    residual: NDArray[np.float64]
    overlap: NDArray[np.float64]
    limit: float

    @classmethod
    def of(cls, steps: list[Matrix], fits: list[Fit], limit: float) -> _Steps:
        step = np.stack(steps) if steps else np.empty((0, 4, 4))
        return cls(step, np.array([f.residual for f in fits]), np.array([f.overlap for f in fits]), limit)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Steps that the scans contradict; False where they cannot tell."""
        return self.overlap < self.limit


def log_steps(scene: Scene) -> list[Matrix] | None:
    """The log's motion of the LiDAR from each scan to the next, or None where a pose is missing or not rigid.

    Returns:
        S - 1 transforms (4, 4) float64: lidar of a scan → lidar of the one before it.
    """
    poses: list[Matrix] = []
    for scan in scene.scans:
        if scan.ego_to_world is None or not is_rigid(scan.ego_to_world) or not is_rigid(scan.lidar_to_ego):
            return None
        poses.append(scan.ego_to_world @ scan.lidar_to_ego)
    return [invert(before) @ after for before, after in pairwise(poses)]


def _predicted(before: Standing, here: Standing, last: Matrix | None, log: Matrix | None) -> Matrix:
    """The motion to start the registration from: the best of what is at hand, or of a search.

    Where no motion is known yet it is searched for even if the log tells one: started from a wrong motion, KISS-ICP
    stays there and confirms it.
    """
    candidates = [motion for motion in (last, log) if motion is not None]
    overlaps = [np.nan_to_num(fit(before, here, motion).overlap, nan=1.0) for motion in candidates]
    if last is not None and max(overlaps) >= LOST:
        return candidates[int(np.argmax(overlaps))]
    return search(before, here, [*candidates, np.eye(4)])


def _chained(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(S, 4, 4) poses in the frame of the first from (S - 1, 4, 4) motions."""
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def _moved(step: Matrix) -> str:
    turn = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
    return f"{np.linalg.norm(step[:3, 3]):.1f} m and {turn:.0f}°"
