"""Annotated images in, whatever format they come in: one reader a format behind :func:`open_annotations`."""

from .open import Format, open_annotations, opened_annotations
from .types import IGNORED, NUSCENES_AND_SKY, Annotated, AnnotatedImage, AnnotationSet, ClassSet, spread

__all__ = [
    "IGNORED",
    "NUSCENES_AND_SKY",
    "Annotated",
    "AnnotatedImage",
    "AnnotationSet",
    "ClassSet",
    "Format",
    "open_annotations",
    "opened_annotations",
    "spread",
]
