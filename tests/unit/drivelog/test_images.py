"""Image sizes from headers."""

import struct

import cv2
import numpy as np
import pytest

from l3ps.drivelog.images import BadImage, image_size

PICTURE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def encoded(kind: str, *options: int) -> bytes:
    return cv2.imencode(kind, PICTURE, list(options))[1].tobytes()


JPEG = encoded(".jpg")
EXIF = b"\xff\xe1" + struct.pack(">H", 60_002) + b"Exif\0\0" + b"\xff\xd8\xff\xc0" * 14_998 + b"\0\0"
WHOLE = {
    "png": encoded(".png"),
    "grey-png": cv2.imencode(".png", PICTURE[:, :, 0])[1].tobytes(),
    "jpeg": JPEG,
    "progressive-jpeg": encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart-markers": encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "preview-before-the-size": JPEG[:2] + EXIF + JPEG[2:],
    "fill-bytes": JPEG[:2] + b"\xff\xff" + JPEG[2:],
    "padding-at-the-end": JPEG + b"\0" * 500,
    "metadata-at-the-end": encoded(".png") + b"x" * 5000,
}
BROKEN = {
    "empty": (b"", "is empty"),
    "text": (b"<html>404</html>", "neither JPEG nor PNG"),
    "cut jpeg": (JPEG[:-30], "cut short"),
    "cut png": (encoded(".png")[:-30], "cut short"),
    "jpeg header only": (JPEG[:20], "damaged or cut short"),
    "png header only": (encoded(".png")[:20], "damaged"),
    "jpeg garbage": (b"\xff\xd8\xff\xe0\0\x04ab" + b"\0" * 100, "damaged"),
    "no pixels": (encoded(".png").replace(struct.pack(">II", 64, 48), struct.pack(">II", 0, 48)), "0x48"),
    "bomb": (encoded(".png").replace(struct.pack(">II", 64, 48), struct.pack(">II", 50_000, 50_000)), "50000x50000"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_size_of_a_whole_image(tmp_path, name):
    path = tmp_path / "image"
    path.write_bytes(WHOLE[name])
    assert image_size(path) == (64, 48)


@pytest.mark.parametrize("name", BROKEN)
def test_broken_image(tmp_path, name):
    content, says = BROKEN[name]
    path = tmp_path / "image"
    path.write_bytes(content)
    with pytest.raises(BadImage, match=says):
        image_size(path)


@pytest.mark.parametrize("whole", [JPEG, WHOLE["png"]])
def test_any_cut_is_noticed(tmp_path, whole):
    path = tmp_path / "image"
    for size in range(0, len(whole) - 1, 97):
        path.write_bytes(whole[:size])
        with pytest.raises(BadImage):
            image_size(path)
