"""Drive logs: types, one reader a format, safe unpacking, pre-flight validation."""

from .archive_formats import ArchiveFault, sniff
from .archive_formats import Kind as ArchiveKind
from .archive_formats import Member as ArchiveMember
from .open import open_drive
from .types import CameraFrame, Drive, LogFormat, Points, Scan, Scene, Truth
from .unpack import check_kind, gather, opened, unpack
from .unpack_sink import UnpackLimits
from .validate import validate, without_bad_scans

__all__ = [
    "ArchiveFault",
    "ArchiveKind",
    "ArchiveMember",
    "CameraFrame",
    "Drive",
    "LogFormat",
    "Points",
    "Scan",
    "Scene",
    "Truth",
    "UnpackLimits",
    "check_kind",
    "gather",
    "open_drive",
    "opened",
    "sniff",
    "unpack",
    "validate",
    "without_bad_scans",
]
