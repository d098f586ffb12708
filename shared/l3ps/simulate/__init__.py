"""Synthetic drives with cameras and full truth: procedural streets, a ray-cast LiDAR, six rendered cameras.

The public face is :func:`simulate_drive`, which writes a log, :func:`annotated_images`, which yields single pictures
with pixel truth for training, and :func:`simulate_images`, which writes such pictures as a folder of annotations.
"""

from .camera import SKY, Picture
from .drive import annotated_images, simulate_drive
from .images import simulate_images, worth_annotating

__all__ = ["SKY", "Picture", "annotated_images", "simulate_drive", "simulate_images", "worth_annotating"]
