"""Scoring the labels of a drive against the truth in its log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Drive, Scan, Scene, Truth
from l3ps.errors import LabelError, Problem
from l3ps.evaluate.evaluator import PanopticEvaluator
from l3ps.evaluate.protocols import Protocol, protocol_named
from l3ps.evaluate.quality import Quality
from l3ps.evaluate.tracking import IdConsistency, id_consistency
from l3ps.labels.reader import LabelFolder, open_labels, wrong_count
from l3ps.labels.spaces import convert
from l3ps.labels.types import ScanLabels
from l3ps.progress import Progress, silent
from l3ps.taxonomy import NUSCENES16


def evaluate_drive(
    drive: Drive,
    labels: Path | LabelFolder,
    protocol: str,
    scene: str | None = None,
    progress: Progress = silent,
    *,
    skip_missing: bool = False,
) -> Quality:
    """Score label files against a log's truth.

    Truth in SemanticKITTI's classes can be scored under any protocol: under ``nuscenes`` and ``paper`` both sides are
    carried into the 16 classes, and points whose class has no counterpart count as void. Truth in nuScenes classes
    cannot be scored under ``semantickitti``: it does not tell the 19 classes apart.

    Args:
        drive: the log with truth.
        labels: folder of label files in any format.
        protocol: ``nuscenes``, ``paper`` or ``semantickitti``.
        scene: limit the evaluation to the scene of this name.
        progress: told each scan under the stage name ``evaluate``.
        skip_missing: leave out scans without a label file (as of a log whose bad scans were skipped) instead of
            refusing; ``Quality.scans`` tells how many are left.

    Raises:
        LabelError: no truth, an unknown scene, a protocol the truth cannot serve, label files that are missing
            (all are named) or of another number of points.
        ValueError: the protocol is unknown.
    """
    rules = protocol_named(protocol)
    scenes = _scenes_with_truth(drive, rules, scene)
    folder = labels if isinstance(labels, LabelFolder) else open_labels(labels)
    scans = [(s, scan) for s in scenes for scan in s.scans if scan.load_truth is not None]
    missing = [folder.missing(s, scan) for s, scan in scans if folder.find(s, scan) is None]
    if missing and (len(missing) == len(scans) or not skip_missing):
        raise LabelError(missing)
    scans = [(s, scan) for s, scan in scans if folder.find(s, scan) is not None] if missing else scans
    evaluator = PanopticEvaluator(protocol)
    for done, (s, scan) in enumerate(scans, 1):
        truth = _truth_in(drive, rules, scan)
        if not folder.has_instances:  # without ids on either side there is nothing to match for the things
            truth = replace(truth, has_instances=False)
        _add(evaluator, scan, truth, *folder.read(s, scan, rules.space.name))
        progress("evaluate", done, len(scans))
    return evaluator.quality()


def evaluate_scene(drive: Drive, scene: Scene, labels: Sequence[ScanLabels], protocol: str) -> PanopticEvaluator:
    """Score labels still in memory; the evaluators of several scenes can be merged.

    Args:
        drive: the log the scene is from.
        scene: the scene.
        labels: labels of its scans in the 16 classes; scans without truth are passed over.
        protocol: ``nuscenes``, ``paper`` or ``semantickitti``.

    Raises:
        LabelError: a protocol the truth cannot serve, or labels of another number of points than the truth.
        ValueError: the protocol is unknown.
    """
    rules = protocol_named(protocol)
    _check_space(drive, rules)
    scans = {scan.token: scan for scan in scene.scans if scan.load_truth is not None}
    evaluator = PanopticEvaluator(protocol)
    for scan_labels in labels:
        scan = scans.get(scan_labels.token)
        if scan is not None:
            # As the writers do: what is stuff has no id, so that files and memory give the same figures.
            instance = np.where(NUSCENES16.is_thing[scan_labels.semantic], scan_labels.instance, 0)
            semantic, instance = convert(scan_labels.semantic, instance, NUSCENES16.name, rules.space.name)
            _add(evaluator, scan, _truth_in(drive, rules, scan), semantic, instance)
    return evaluator


def follow_ids(drive: Drive, scene: Scene, labels: Sequence[ScanLabels]) -> IdConsistency:
    """How well ids follow the objects through a scene; scans without true instances are passed over.

    Args:
        drive: the log the scene is from.
        scene: the scene.
        labels: labels of its scans.
    """
    rules = protocol_named(NUSCENES16.name)
    scans = {scan.token: scan for scan in scene.scans if scan.load_truth is not None}
    pairs = [(_truth_in(drive, rules, scans[of.token]), of) for of in labels if of.token in scans]
    pairs = [(truth, of) for truth, of in pairs if truth.has_instances]
    return id_consistency([truth for truth, _ in pairs], [of for _, of in pairs])


def _truth_in(drive: Drive, rules: Protocol, scan: Scan) -> Truth:
    """The scan's truth in the protocol's label space."""
    assert scan.load_truth is not None
    truth = scan.load_truth()
    semantic, instance = convert(truth.semantic, truth.instance, drive.truth_space, rules.space.name)
    return replace(truth, semantic=semantic, instance=instance.astype(np.int32))


def _add(
    evaluator: PanopticEvaluator,
    scan: Scan,
    truth: Truth,
    semantic: NDArray[np.uint8],
    instance: NDArray[np.int64],
) -> None:
    """Count one scan, after making sure that labels and truth are of the same points."""
    if len(semantic) != len(truth.semantic):
        raise wrong_count(scan, len(semantic), len(truth.semantic))
    evaluator.add(truth, semantic, instance)


def _scenes_with_truth(drive: Drive, rules: Protocol, name: str | None) -> list[Scene]:
    """The scenes to evaluate, after checking that there is something to evaluate."""
    _check_space(drive, rules)
    scenes = [scene for scene in drive.scenes if name is None or scene.name == name]
    if not scenes:
        known = ", ".join(scene.name for scene in drive.scenes[:10])
        raise _bad(drive, "unknown-scene", f"has no scene {name!r}", f"Its scenes are: {known}.")
    if not any(scan.load_truth is not None for scene in scenes for scan in scene.scans):
        where = "" if name is None else f" in scene {name}"
        raise _bad(drive, "no-truth", f"has no annotated labels{where}", "Evaluate a log that carries truth.")
    return scenes


def _check_space(drive: Drive, rules: Protocol) -> None:
    """LabelError where the truth does not tell the protocol's classes apart."""
    if rules.space.name != drive.truth_space and rules.space is not NUSCENES16:
        raise _bad(
            drive,
            "protocol-mismatch",
            f"has truth in {drive.truth_space} classes, which protocol {rules.name} cannot score",
            "Choose protocol nuscenes or paper.",
        )


def _bad(drive: Drive, code: str, what: str, remedy: str) -> LabelError:
    return LabelError(Problem(code=code, where=str(drive.root), what=what, remedy=remedy))
