"""Panoptic quality and IoU under the three protocols."""
