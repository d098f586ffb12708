"""Image files to network input."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from l3ps.errors import DriveLogError, Problem
from l3ps.segment.bundle import InputSpec

Box = tuple[float, float, float, float]
"""Left, top, right and bottom edge of a part of an image, in pixels."""


def open_image(path: Path) -> Image.Image:
    """Decode an image file as RGB; grey images get three equal channels.

    Raises:
        DriveLogError: when the file is missing or cannot be decoded.
    """
    try:
        with Image.open(path) as image:
            image.load()
            return image if image.mode == "RGB" else image.convert("RGB")
    except FileNotFoundError as error:
        raise DriveLogError(
            Problem("missing-image", path.name, "the image file is not there", "Restore the file.")
        ) from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        what = f"it cannot be decoded as an image ({error})"
        remedy = "Replace the file by a complete JPEG or PNG."
        raise DriveLogError(Problem("broken-image", path.name, what, remedy)) from error


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode an image file to (H, W, 3) uint8 RGB. DriveLogError as in :func:`open_image`."""
    return np.asarray(open_image(path), dtype=np.uint8)


def network_input(image: Image.Image, spec: InputSpec, box: Box | None = None) -> NDArray[np.float32]:
    """Resize and normalise an image for a network.

    Shrinking averages over the covered area (Pillow's bilinear filter), as in the networks' own training pipelines,
    so that fine texture does not alias into false classes.

    Args:
        image: RGB.
        spec: the bundle's input.
        box: the part of the image to take; None takes all.

    Returns:
        (1, 3, height, width) float32.
    """
    resized = np.asarray(image.resize((spec.width, spec.height), Image.Resampling.BILINEAR, box))
    # A byte has 256 values: (x * scale - mean) / std is looked up, in a tenth of the time of computing it.
    scale = 1 / 255 if spec.range == "0..1" else 1.0
    std = np.asarray(spec.std, dtype=np.float32)
    gain, offset = np.float32(scale) / std, np.asarray(spec.mean, dtype=np.float32) / std
    values = np.arange(256, dtype=np.float32) * gain[:, None] - offset[:, None]
    planes = np.empty((1, 3, spec.height, spec.width), dtype=np.float32)
    for channel, plane in enumerate(cv2.split(resized)):
        cv2.LUT(plane, values[channel], dst=planes[0, channel])
    return planes
