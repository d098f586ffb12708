"""Drive logs: types, one reader a format, safe unpacking, pre-flight validation."""

from .archive_formats import Kind as ArchiveKind
from .archive_formats import sniff
from .open import open_drive
from .types import CameraFrame, Drive, LogFormat, Points, Scan, Scene, Truth
from .unpack import UnpackLimits, check_kind, opened, unpack
from .validate import validate, without_bad_scans

__all__ = [
    "ArchiveKind",
    "CameraFrame",
    "Drive",
    "LogFormat",
    "Points",
    "Scan",
    "Scene",
    "Truth",
    "UnpackLimits",
    "check_kind",
    "open_drive",
    "opened",
    "sniff",
    "unpack",
    "validate",
    "without_bad_scans",
]
