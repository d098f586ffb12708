"""Synthetic drives with cameras and full truth."""
