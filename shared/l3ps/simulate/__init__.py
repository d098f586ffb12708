"""Synthetic drives with cameras and full truth: procedural streets, a ray-cast LiDAR, six rendered cameras.

The public face is :func:`simulate_drive`, which writes a log, and :func:`annotated_images`, which yields single
pictures with pixel truth for training.
"""

from .camera import SKY, Picture
from .drive import annotated_images, simulate_drive

__all__ = ["SKY", "Picture", "annotated_images", "simulate_drive"]
