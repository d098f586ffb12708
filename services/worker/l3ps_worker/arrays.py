"""Primal labels as one compressed object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from l3ps.labels.types import Evidence, ScanLabels


def write_labels(path: Path, labels: Sequence[ScanLabels]) -> None:
    """Write a scene's labels to an npz file: tokens, points a scan, and all classes and ids one after the other.

    The evidence goes with them where every scan has it.
    """
    arrays = {
        "tokens": np.array([scan.token for scan in labels], dtype=np.str_),
        "sizes": np.array([len(scan.semantic) for scan in labels], dtype=np.int64),
        "semantic": np.concatenate([scan.semantic for scan in labels]) if labels else np.zeros(0, np.uint8),
        "instance": np.concatenate([scan.instance for scan in labels]) if labels else np.zeros(0, np.int32),
    }
    evidence = [scan.evidence for scan in labels if scan.evidence is not None]
    if labels and len(evidence) == len(labels):
        for name in _EVIDENCE:
            arrays[f"evidence_{name}"] = np.concatenate([getattr(part, name) for part in evidence])
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def read_labels(path: Path) -> list[ScanLabels]:
    """The labels that :func:`write_labels` wrote, by this or an earlier version: those had no evidence."""
    with np.load(path, allow_pickle=False) as stored:
        bounds = np.cumsum(stored["sizes"])[:-1]
        tokens = stored["tokens"].tolist()
        evidence: list[Evidence | None] = [None] * len(tokens)
        if all(f"evidence_{name}" in stored.files for name in _EVIDENCE):
            columns = [np.split(stored[f"evidence_{name}"], bounds) for name in _EVIDENCE]
            evidence = [Evidence(*parts) for parts in zip(*columns, strict=True)]
        semantic, instance = np.split(stored["semantic"], bounds), np.split(stored["instance"], bounds)
        return [ScanLabels(*parts) for parts in zip(tokens, semantic, instance, evidence, strict=True)]


_EVIDENCE = tuple(column.name for column in fields(Evidence))
