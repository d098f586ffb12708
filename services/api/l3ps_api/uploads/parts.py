"""How a file is cut into the parts of a multipart upload."""

from __future__ import annotations

from l3ps_platform.catalog import UploadRow
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


def size_of_parts(row: UploadRow, settings: Settings) -> int:
    """Bytes of every part but the last of an upload, whatever the settings say by now."""
    return row.part_size or part_size(row.size, settings)


def part_length(number: int, row: UploadRow, settings: Settings) -> int:
    """Bytes of one part of an upload, numbered from 1; 0 or less for one that it does not have."""
    each = size_of_parts(row, settings)
    return min(each, row.size - (number - 1) * each)


def largest_part(settings: Settings) -> int:
    """The largest part any upload may have."""
    return part_size(max(settings.max_upload_bytes, settings.max_model_bytes, settings.max_annotations_bytes), settings)
