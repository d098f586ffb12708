"""How a file is cut into the parts of a multipart upload."""

from __future__ import annotations

from l3ps_platform.settings import MiB, Settings

MAX_PARTS = 10_000
"""S3's limit."""


def part_size(size: int, settings: Settings) -> int:
    """Bytes of every part but the last for a file of ``size`` bytes: the settings', more where the parts run out."""
    needed = -(-size // MAX_PARTS)
    return max(settings.part_bytes, -(-needed // MiB) * MiB)


def part_count(size: int, settings: Settings) -> int:
    """How many parts a file of ``size`` bytes has."""
    return max(1, -(-size // part_size(size, settings)))


def part_length(number: int, size: int, settings: Settings) -> int:
    """Bytes of one part, numbered from 1, of a file of ``size`` bytes."""
    each = part_size(size, settings)
    return min(each, size - (number - 1) * each)


def largest_part(settings: Settings) -> int:
    """The largest part any upload may have."""
    return part_size(max(settings.max_upload_bytes, settings.max_model_bytes, settings.max_annotations_bytes), settings)
