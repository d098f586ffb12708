"""Reading labels back, whoever wrote them, from a folder whose format and layout are found out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.drivelog.types import Scan, Scene
from l3ps.errors import LabelError, Problem
from l3ps.labels import nuscenes, semantickitti
from l3ps.labels.files import file_stem, folder_name
from l3ps.labels.spaces import convert
from l3ps.labels.types import ScanLabels
from l3ps.labels.writer import LabelFormat
from l3ps.taxonomy import NUSCENES16

_SUFFIXES: dict[str, LabelFormat] = {
    nuscenes.PANOPTIC_SUFFIX: "nuscenes",
    semantickitti.SUFFIX: "semantickitti",
    nuscenes.LIDARSEG_SUFFIX: "nuscenes",
}
"""What tells the formats apart; panoptic files win over the lidarseg files beside them."""


@dataclass(frozen=True, slots=True)
class LabelFolder:
    """A folder of label files of one format.

    Attributes:
        root: the folder.
        format: the format its files are in.
        suffix: what its files' names end in.
        files: file by name and, in the sequence layout, by (sequence folder, name) too.
    """

    root: Path
    format: LabelFormat
    suffix: str
    files: dict[str | tuple[str, str], Path] = field(repr=False)

    @property
    def has_instances(self) -> bool:
        """False where there is nothing but lidarseg files."""
        return self.suffix != nuscenes.LIDARSEG_SUFFIX

    def find(self, scene: Scene, scan: Scan) -> Path | None:
        """The label file of a scan, or None."""
        name = self._name(scan)
        return self.files.get((folder_name(scene.name), name)) or self.files.get(name)

    def _name(self, scan: Scan) -> str:
        """How the scan's file is called."""
        if self.suffix == semantickitti.SUFFIX:
            return semantickitti.file_name(scan)
        return f"{file_stem(scan.token)}{self.suffix}"

    def read(
        self, scene: Scene, scan: Scan, space: str = NUSCENES16.name
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Classes and ids of a scan.

        Args:
            scene: the scan's scene.
            scan: the scan.
            space: the label space wanted, ``nuscenes`` or ``semantickitti``.

        Returns:
            (N,) uint8 class in that space and (N,) int64 id, 0 = none, unique within a class.

        Raises:
            LabelError: there is no file of that scan, or it cannot be read.
        """
        path = self.find(scene, scan)
        if path is None:
            raise LabelError(self.missing(scene, scan))
        if self.suffix == semantickitti.SUFFIX:
            return semantickitti.read(path, space)
        if self.suffix == nuscenes.PANOPTIC_SUFFIX:
            semantic, instance = nuscenes.read_panoptic(path)
        else:
            semantic = nuscenes.read_lidarseg(path)
            instance = np.zeros(len(semantic), dtype=np.int32)
        return convert(semantic, instance, NUSCENES16.name, space)

    def missing(self, scene: Scene, scan: Scan) -> Problem:
        """What to say of a scan without a label file."""
        return Problem(
            code="missing-labels",
            where=str(self.root),
            what=f"has no {self._name(scan)} for scan {scan.index} of scene {scene.name}",
            remedy="Name the folder that was made from this log, or label the log again.",
            scene=scene.name,
            scan=scan.token,
        )


def open_labels(path: Path, format: LabelFormat | None = None) -> LabelFolder:
    """Find the label files in a folder, in whatever layout.

    Understood: ``panoptic/<token>_panoptic.npz`` and ``lidarseg/<token>_lidarseg.bin``, with or without those folders
    or one of the evaluation set below them (the nuScenes submission), and
    ``sequences/<scene>/predictions/<token>.label`` (or ``labels/``).

    Args:
        path: the folder.
        format: read this format only; None takes the first found of panoptic npz, .label, lidarseg bin.

    Raises:
        LabelError: there is no such folder, no label file in it, or two files for one scan.
    """
    if not path.is_dir():
        raise _bad(path, "missing-label-folder", "is no folder", "Name the folder that holds the label files.")
    for suffix, suffix_format in _SUFFIXES.items():
        if format not in (None, suffix_format):
            continue
        found = sorted(path.rglob(f"*{suffix}"))
        found = [file for file in found if file.parent.name == "predictions"] or found
        if found:
            return LabelFolder(path, suffix_format, suffix, _indexed(path, suffix, found))
    wanted = ", ".join(f"*{suffix}" for suffix, f in _SUFFIXES.items() if format in (None, f))
    raise _bad(path, "no-labels", f"holds no label files ({wanted})", "Name a folder written by `l3ps label`.")


def _indexed(root: Path, suffix: str, found: list[Path]) -> dict[str | tuple[str, str], Path]:
    """Files by name; in several sequences a name is only good together with its sequence."""
    in_sequences = suffix == semantickitti.SUFFIX
    files: dict[str | tuple[str, str], Path] = {}
    shared: set[str] = set()
    for file in found:
        key: str | tuple[str, str] = (file.parent.parent.name, file.name) if in_sequences else file.name
        if key in files:
            raise _bad(
                root,
                "ambiguous-labels",
                f"holds {file.name} twice ({files[key].relative_to(root)}, {file.relative_to(root)})",
                "Name the one folder to read, for example its refined/.",
            )
        files[key] = file
        if in_sequences and files.setdefault(file.name, file) != file:
            shared.add(file.name)
    for name in shared:
        del files[name]
    return files


def read_scan(out: Path | LabelFolder, format: LabelFormat | None, scene: Scene, scan: Scan) -> ScanLabels:
    """The labels of one scan in the 16 classes.

    Args:
        out: the folder, or one opened before, which saves listing it for every scan.
        format: the format to read; None finds out. Ignored for an opened folder.
        scene: the scan's scene.
        scan: the scan.

    Raises:
        LabelError: the folder, or the file of that scan in it, is missing or unreadable.
    """
    folder = out if isinstance(out, LabelFolder) else open_labels(out, format)
    semantic, instance = folder.read(scene, scan)
    return ScanLabels(scan.token, semantic, instance.astype(np.int32))


def wrong_count(scan: Scan, labels: int, points: int) -> LabelError:
    """What to say of labels that are not one a point."""
    return LabelError(
        Problem(
            code="label-count",
            where=f"labels of scan {scan.token}",
            what=f"have {labels:,} values but the scan has {points:,} points",
            remedy="Were they made from another log? Label this one, or name the log they were made from.",
            scan=scan.token,
        )
    )


def _bad(path: Path, code: str, what: str, remedy: str) -> LabelError:
    return LabelError(Problem(code=code, where=str(path), what=what, remedy=remedy))
