"""Primal labels as one compressed object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from l3ps.labels.types import ScanLabels


def write_labels(path: Path, labels: Sequence[ScanLabels]) -> None:
    """Write a scene's labels to an npz file: tokens, points a scan, and all classes and ids one after the other."""
    sizes = [len(scan.semantic) for scan in labels]
    np.savez_compressed(
        path,
        tokens=np.array([scan.token for scan in labels], dtype=np.str_),
        sizes=np.array(sizes, dtype=np.int64),
        semantic=np.concatenate([scan.semantic for scan in labels]) if labels else np.zeros(0, np.uint8),
        instance=np.concatenate([scan.instance for scan in labels]) if labels else np.zeros(0, np.int32),
    )


def read_labels(path: Path) -> list[ScanLabels]:
    """The labels that :func:`write_labels` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        bounds = np.cumsum(stored["sizes"])[:-1]
        parts = zip(
            stored["tokens"].tolist(),
            np.split(stored["semantic"], bounds),
            np.split(stored["instance"], bounds),
            strict=True,
        )
        return [ScanLabels(token, semantic, instance) for token, semantic, instance in parts]
