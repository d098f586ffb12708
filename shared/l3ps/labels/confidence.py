"""How sure each label is and where it comes from, in a file of its own beside the label file.

``<name>_confidence.npz`` holds, a value a point in point-file order,

- ``confidence``: uint8, 255 = certain, the estimated probability that the class is right; 0 where it is void;
- ``provenance``: uint8, a code of :class:`l3ps.labels.types.Provenance`: 0 none, 1 camera, 2 neighbours, 3 cluster,
  4 noise fill, 5 ground rule, 6 instance rule.

It lies in ``confidence/`` next to ``panoptic/`` (or to ``predictions/`` of a SemanticKITTI sequence), where readers of
either format do not look. Primal labels have none.
"""

from __future__ import annotations

import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l3ps.errors import LabelError, Problem
from l3ps.labels.files import write_whole
from l3ps.labels.types import ScanLabels

FOLDER = "confidence"
SUFFIX = "_confidence.npz"


def write(folder: Path, stem: str, labels: ScanLabels) -> list[Path]:
    """Write a scan's confidence and provenance where it has both.

    Args:
        folder: the folder that holds the folder of label files.
        stem: how the scan's label file is called, without its suffix.
        labels: the scan's labels.

    Returns:
        The file written, if any.
    """
    if labels.confidence is None or labels.provenance is None:
        return []
    content = BytesIO()
    np.savez_compressed(content, confidence=labels.confidence, provenance=labels.provenance)
    return [write_whole(folder / FOLDER / f"{stem}{SUFFIX}", content.getvalue())]


def read(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Confidence and provenance, (N,) uint8 each, of a file that :func:`write` wrote.

    Raises:
        LabelError: the file cannot be read, or does not hold one byte a point of each.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            confidence, provenance = archive["confidence"], archive["provenance"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _bad(path, "is not a readable npz file of confidence and provenance") from error
    one_byte = confidence.dtype == provenance.dtype == np.uint8
    if not one_byte or confidence.ndim != 1 or confidence.shape != provenance.shape:
        raise _bad(path, "does not hold one byte a point of each array")
    return confidence, provenance


def _bad(path: Path, what: str) -> LabelError:
    return LabelError(
        Problem(code="unreadable-labels", where=str(path), what=what, remedy="Label the log again to write it.")
    )
