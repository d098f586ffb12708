"""Image files to network input."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.errors import DriveLogError, Problem
from l3ps.segment.bundle import InputSpec


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode an image file to (H, W, 3) uint8 RGB; grey images get three equal channels.

    Raises:
        DriveLogError: when the file is missing or cannot be decoded.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DriveLogError(
            Problem("missing-image", path.name, f"the image cannot be read ({error.strerror})", "Restore the file.")
        ) from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise DriveLogError(
            Problem(
                "broken-image",
                path.name,
                f"its {data.size} bytes cannot be decoded as an image",
                "Replace the file by a complete JPEG or PNG.",
            )
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def network_input(image: NDArray[np.uint8], spec: InputSpec) -> NDArray[np.float32]:
    """Resize and normalise an image for a network.

    Shrinking averages over the covered area, so that fine texture does not alias into false classes.

    Args:
        image: (H, W, 3) uint8 RGB.
        spec: the bundle's input.

    Returns:
        (1, 3, height, width) float32.
    """
    shrinks = image.shape[1] > spec.width or image.shape[0] > spec.height
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    resized = cv2.resize(image, (spec.width, spec.height), interpolation=interpolation)
    scale = 1 / 255 if spec.range == "0..1" else 1.0
    std = np.asarray(spec.std, dtype=np.float32)
    # One multiply-add a channel: (x * scale - mean) / std.
    gain, offset = np.float32(scale) / std, np.asarray(spec.mean, dtype=np.float32) / std
    planes = resized.transpose(2, 0, 1) * gain[:, None, None] - offset[:, None, None]
    return np.ascontiguousarray(planes[None], dtype=np.float32)
