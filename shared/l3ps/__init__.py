"""Panoptic labels for LiDAR drive logs, after "Label-Efficient LiDAR Panoptic Segmentation" (arXiv 2503.02372)."""
