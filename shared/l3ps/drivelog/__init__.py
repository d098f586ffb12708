"""Drive logs: types, one reader a format, safe unpacking, pre-flight validation."""

from .open import open_drive
from .types import CameraFrame, Drive, LogFormat, Points, Scan, Scene, Truth

__all__ = [
    "CameraFrame",
    "Drive",
    "LogFormat",
    "Points",
    "Scan",
    "Scene",
    "Truth",
    "open_drive",
]
