"""Writing a scene's labels in the format asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from l3ps.drivelog.types import Scene
from l3ps.labels import nuscenes, semantickitti
from l3ps.labels.types import ScanLabels
from l3ps.taxonomy import NUSCENES16

LabelFormat = Literal["nuscenes", "semantickitti"]
FORMATS: tuple[LabelFormat, ...] = get_args(LabelFormat)
"""Formats labels can be written and read in."""


def write_scene(out: Path, format: LabelFormat, scene: Scene, labels: Sequence[ScanLabels]) -> list[Path]:
    """Write the labels of a scene; each file appears whole or not at all.

    Args:
        out: the folder, shared by all scenes of a drive.
        format: ``nuscenes`` (panoptic npz and lidarseg bin) or ``semantickitti`` (.label); labels that have them get
            a file of confidences beside either.
        scene: the scene the labels belong to.
        labels: scans in order; scans of the scene may be missing (bad scans that were skipped).

    Returns:
        The files written.

    Raises:
        LabelError: more objects than the format can number, or a token that cannot be a file name.
        ValueError: labels of a scan that is not the scene's, or malformed ones: a fault of the caller.
    """
    tokens = {scan.token for scan in scene.scans}
    for scan in labels:
        if scan.token not in tokens:
            raise ValueError(f"scan {scan.token} is not of scene {scene.name}")
        if scan.semantic.ndim != 1 or scan.semantic.shape != scan.instance.shape:
            raise ValueError(f"scan {scan.token}: {scan.semantic.shape} classes but {scan.instance.shape} ids")
        if scan.semantic.size and (int(scan.semantic.max()) >= len(NUSCENES16.classes) or int(scan.instance.min()) < 0):
            raise ValueError(f"scan {scan.token}: classes must be 0–16 and ids at least 0")
        for extra in (scan.confidence, scan.provenance):
            if extra is not None and (extra.shape != scan.semantic.shape or extra.dtype != np.uint8):
                raise ValueError(f"scan {scan.token}: confidence and provenance must be one byte a point")
    if format == "nuscenes":
        return nuscenes.write(out, scene.name, labels)
    if format == "semantickitti":
        return semantickitti.write(out, scene, labels)
    raise ValueError(f"unknown label format {format!r}: choose one of {', '.join(FORMATS)}")
