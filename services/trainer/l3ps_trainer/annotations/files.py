"""Image and label files: sizes from headers, pixels when they are needed, one clause for whatever is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from l3ps.drivelog.images import MAX_PIXELS, BadImage, image_size
from l3ps.drivelog.names import is_hidden

PICTURES: Final = (".png", ".jpg", ".jpeg", ".npy")
LABELS: Final = (".png", ".npy")
"""JPEG changes values, so no label map is one."""
DAMAGED: Final = (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError)


class BadFile(ValueError):  # noqa: N818  (a clause for a Problem)
    """A file cannot be used; the message is a clause that says why."""


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image or label file from its header.

    Raises:
        BadFile: missing, damaged, cut short or of another kind.
    """
    if path.suffix.lower() == ".npy":
        shape = _mapped(path).shape
        if len(shape) < 2 or shape[0] * shape[1] > MAX_PIXELS:
            raise BadFile(f"its array has the shape {shape}, which is no image")
        return shape[1], shape[0]
    try:
        return image_size(path)
    except BadImage as error:
        raise BadFile(str(error)) from error
    except OSError as error:
        raise BadFile(_unread(error)) from error


def read_picture(path: Path) -> NDArray[np.uint8]:
    """An image as (H, W, 3) uint8 RGB; grey images get three equal channels.

    Raises:
        BadFile: missing, damaged or no image.
    """
    if path.suffix.lower() == ".npy":
        array = np.array(_mapped(path))
        if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            raise BadFile(f"its array is {array.dtype} of shape {array.shape}, not uint8 of shape (height, width, 3)")
        return array
    size_of(path)
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"), dtype=np.uint8)
    except DAMAGED as error:
        raise BadFile(f"it cannot be decoded ({error})") from error


def read_labels(path: Path) -> NDArray[Any]:
    """A label map as an (H, W) array of integers; a palette image gives the indices.

    Raises:
        BadFile: missing, damaged, or with several channels.
    """
    if path.suffix.lower() == ".npy":
        array = np.array(_mapped(path))
    else:
        size_of(path)
        try:
            with Image.open(path) as image:
                array = np.asarray(image)
        except DAMAGED as error:
            raise BadFile(f"it cannot be decoded ({error})") from error
    if array.dtype == np.bool_:
        array = array.astype(np.uint8)
    if array.ndim != 2 or array.dtype.kind not in "iu":
        raise BadFile(f"it holds {array.dtype} of shape {array.shape}, not one integer a pixel")
    return array


def by_stem(folder: Path, endings: tuple[str, ...]) -> tuple[dict[str, Path], list[tuple[Path, str]]]:
    """The files of a folder by their name without ending.

    Args:
        folder: to look into, not below.
        endings: that are read, in lower case.

    Returns:
        Stem → file in the order of names, and the files that cannot be meant with a clause each that says why.
    """
    found: dict[str, Path] = {}
    others: list[tuple[Path, str]] = []
    for path in sorted(p for p in folder.iterdir() if not is_hidden(p)):
        if path.is_dir():
            others.append((path, "it is a folder among the files"))
        elif path.suffix.lower() not in endings:
            others.append((path, f"it is none of {', '.join(endings)}"))
        elif path.stem in found:
            others.append((path, f"it has the same name as {found[path.stem].name}"))
        else:
            found[path.stem] = path
    return found, others


def _mapped(path: Path) -> NDArray[Any]:
    """An array file, unread: a header that claims more than the file holds is an error at once."""
    try:
        return np.asarray(np.lib.format.open_memmap(path, mode="r"))
    except OSError as error:
        raise BadFile(_unread(error)) from error
    except (ValueError, EOFError, SyntaxError) as error:
        raise BadFile(f"it is no numpy array file ({error})") from error


def _unread(error: OSError) -> str:
    return "the file is not there" if isinstance(error, FileNotFoundError) else f"it cannot be read ({error})"
