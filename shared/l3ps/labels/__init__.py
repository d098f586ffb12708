"""Label files: one writer and reader a format."""

from l3ps.labels.confidence import read as read_confidence
from l3ps.labels.poses import read_poses, write_poses
from l3ps.labels.reader import LabelFolder, open_labels, read_scan
from l3ps.labels.types import Evidence, Provenance, ScanLabels
from l3ps.labels.writer import FORMATS, LabelFormat, write_scene

__all__ = [
    "FORMATS",
    "Evidence",
    "LabelFolder",
    "LabelFormat",
    "Provenance",
    "ScanLabels",
    "open_labels",
    "read_confidence",
    "read_poses",
    "read_scan",
    "write_poses",
    "write_scene",
]
