"""Image files to network input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from l3ps.errors import DriveLogError, Problem
from l3ps.segment.bundle import InputSpec


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode an image file to (H, W, 3) uint8 RGB; grey images get three equal channels.

    Raises:
        DriveLogError: when the file is missing or cannot be decoded.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"), dtype=np.uint8)
    except FileNotFoundError as error:
        raise DriveLogError(
            Problem("missing-image", path.name, "the image file is not there", "Restore the file.")
        ) from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        what = f"it cannot be decoded as an image ({error})"
        remedy = "Replace the file by a complete JPEG or PNG."
        raise DriveLogError(Problem("broken-image", path.name, what, remedy)) from error


def network_input(image: NDArray[np.uint8], spec: InputSpec) -> NDArray[np.float32]:
    """Resize and normalise an image for a network.

    Shrinking averages over the covered area (Pillow's bilinear filter), as in the networks' own training pipelines,
    so that fine texture does not alias into false classes.

    Args:
        image: (H, W, 3) uint8 RGB.
        spec: the bundle's input.

    Returns:
        (1, 3, height, width) float32.
    """
    resized = np.asarray(Image.fromarray(image).resize((spec.width, spec.height), Image.Resampling.BILINEAR))
    scale = 1 / 255 if spec.range == "0..1" else 1.0
    std = np.asarray(spec.std, dtype=np.float32)
    # One multiply-add a channel: (x * scale - mean) / std.
    gain, offset = np.float32(scale) / std, np.asarray(spec.mean, dtype=np.float32) / std
    planes = resized.transpose(2, 0, 1) * gain[:, None, None] - offset[:, None, None]
    return np.ascontiguousarray(planes[None], dtype=np.float32)
