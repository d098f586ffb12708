"""Well-packed logs whose tables, points or images are not what they should be."""

import json
import struct
import zlib
from typing import Any

import numpy as np

from .archives import zipped
from .case import Case, case
from .samples import TABLES, Samples

NAN, INF = float("nan"), float("inf")


def _set(name: str, value: object) -> Any:
    return lambda row: row.update({name: value})


def _camera_matrix(samples: Samples, value: object) -> bytes:
    def change(row: dict[str, Any]) -> None:
        if row["camera_intrinsic"]:
            row["camera_intrinsic"] = value

    return samples.with_rows("calibrated_sensor", change)


def _stamps(samples: Samples, stamp: Any) -> bytes:
    """The log with a rule for the time stamps of its samples and data, by their place in the scene."""
    scans = [row for row in samples.rows("sample_data") if "LIDAR_TOP" in row["filename"] and row["is_key_frame"]]
    place = {row["sample_token"]: number for number, row in enumerate(sorted(scans, key=lambda r: r["timestamp"]))}
    data, sample = samples.rows("sample_data"), samples.rows("sample")
    for row in data:
        row["timestamp"] = stamp(place[row["sample_token"]])
    for row in sample:
        row["timestamp"] = stamp(place[row["token"]])
    changed = {f"{TABLES}/{name}.json": json.dumps(rows).encode() for name, rows in
               (("sample_data", data), ("sample", sample))}  # fmt: skip
    return zipped(samples.log | changed)


def _same_token(samples: Samples) -> bytes:
    rows = samples.rows("sample_data")
    for row in rows:
        row["token"] = rows[0]["token"]
    return samples.with_table("sample_data", rows)


def _two_scenes_of_one_name(samples: Samples) -> bytes:
    (row,) = samples.rows("scene")
    return samples.with_table("scene", [row, row | {"token": "other"}])


def _points_outside(name: str) -> Any:
    return lambda s: s.with_rows("sample_data", _set("filename", name))


def _png(width: int, height: int, *, good_crc: bool = True, data: bytes = b"") -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        crc = zlib.crc32(kind + content) ^ (not good_crc)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    end = b"\0\0\0\0IEND\xaeB\x60\x82"
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + end


def _jpeg(content: bytes, width: int, height: int) -> bytes:
    """A JPEG whose frame header claims another size."""
    at = content.find(b"\xff\xc0")
    return content[: at + 5] + struct.pack(">HH", height, width) + content[at + 9 :]


def _without_end(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _truth(samples: Samples, content: bytes) -> bytes:
    names = [name for name in samples.log if name.startswith("panoptic/")]
    return zipped(samples.log | dict.fromkeys(names, content))


def _npy(shape: str, kind: str = "<u2") -> bytes:
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return zipped({"data.npy": b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head})


def _first_nan(points: Any) -> Any:
    points[0, 0] = NAN
    return points


def _times(factor: float) -> Any:
    return lambda points: points * np.float32(factor)


def _kitti(
    scan: bytes, times: str, calib: str = "P2: 40 0 32 0 0 40 24 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
) -> bytes:
    folder = "dataset/sequences/00"
    return zipped(
        {
            **{f"{folder}/velodyne/{number:06d}.bin": scan for number in range(3)},
            f"{folder}/times.txt": times.encode(),
            f"{folder}/calib.txt": calib.encode(),
        }
    )


_SCAN = np.ones((100, 4), "<f4").tobytes()
DEEP = "[" * 100_000 + "]" * 100_000
LONG_NUMBER = "9" * 50_000
TABLE = "bad-table"
SPOILT = "job"
"""Every scan is bad in a way that a job may skip; no scan is left."""

CASES: list[Case] = [
    case("scene-deep.zip", lambda s: s.with_table("scene", f"[{DEEP}]"), TABLE, "scene.json"),
    case("scene-deep-object.zip", lambda s: s.with_table("scene", '[{"a":' * 50_000), TABLE, "scene.json"),
    case("scene-object.zip", lambda s: s.with_table("scene", {"token": "a"}), TABLE, "scene.json"),
    case("scene-string.zip", lambda s: s.with_table("scene", '"scene"'), TABLE, "scene.json"),
    case("scene-null.zip", lambda s: s.with_table("scene", "null"), TABLE, "scene.json"),
    case("scene-empty.zip", lambda s: s.with_table("scene", ""), TABLE, "scene.json"),
    case("scene-no-rows.zip", lambda s: s.with_table("scene", "[]"), "no-scans", "scene.json"),
    case("scene-numbers.zip", lambda s: s.with_table("scene", "[1, 2, 3]"), TABLE, "scene.json"),
    case("scene-cut.zip", lambda s: s.with_table("scene", '[{"token": "a", '), TABLE, "scene.json"),
    case("scene-utf-16.zip", lambda s: s.with_table("scene", "[]".encode("utf-16")), TABLE, "scene.json"),
    case("scene-no-text.zip", lambda s: s.with_table("scene", b'["\xff\xfe"]'), TABLE, "scene.json"),
    case(
        "sample-long-number.zip", lambda s: s.with_table("sample", f'[{{"timestamp": {LONG_NUMBER}}}]'), TABLE, "sample"
    ),
    case("endless-row.zip", lambda s: s.with_table("sample", '[{"token": "' + "a" * (9 << 20)), TABLE, "sample.json"),
    case("scene-name-leads-out.zip", lambda s: s.with_rows("scene", _set("name", "../../evil")), TABLE, "scene.json"),
    case("scene-name-empty.zip", lambda s: s.with_rows("scene", _set("name", "")), TABLE, "scene.json"),
    case("token-leads-out.zip", lambda s: s.with_rows("sample_data", _set("token", "../evil")), TABLE, "sample_data"),
    case("token-number.zip", lambda s: s.with_rows("sample_data", _set("token", 7)), TABLE, "sample_data.json"),
    case("same-token.zip", _same_token, "duplicate-token", "sample_data.json"),
    case("same-scene.zip", _two_scenes_of_one_name, "duplicate-scene", "scene.json"),
    *(
        case(f"without-{table}.zip", lambda s, t=table: s.without(f"/{t}.json"), "missing-table", table)
        for table in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose")
    ),
    case("no-lidar.zip", lambda s: s.with_rows("sensor", _set("modality", "camera")), "no-lidar", "sensor.json"),
    case("unknown-sensors.zip", lambda s: s.with_table("sensor", "[]"), "no-lidar missing-calibration"),
    case("pose-nan.zip", lambda s: s.with_rows("ego_pose", _set("translation", [NAN, 0, 0])), "bad-pose", "ego_pose"),
    case("pose-inf.zip", lambda s: s.with_rows("ego_pose", _set("translation", [INF, 0, 0])), "bad-pose", "ego_pose"),
    case("pose-1e400.zip", lambda s: s.with_rows("ego_pose", _set("translation", [10**400, 0, 0])), "bad-pose", "ego"),
    case("pose-zero.zip", lambda s: s.with_rows("ego_pose", _set("rotation", [0, 0, 0, 0])), "bad-pose", "ego_pose"),
    case("pose-text.zip", lambda s: s.with_rows("ego_pose", _set("rotation", "east")), TABLE, "ego_pose.json"),
    case(
        "calibration-nan.zip",
        lambda s: s.with_rows("calibrated_sensor", _set("rotation", [NAN] * 4)),
        "bad-calibration",
    ),
    case("intrinsic-inf.zip", lambda s: _camera_matrix(s, [[INF, 0, 1], [0, 1, 1], [0, 0, 1]]), "bad-calibration"),
    case("intrinsic-negative.zip", lambda s: _camera_matrix(s, [[-1, 0, 1], [0, 1, 1], [0, 0, 1]]), "bad-calibration"),
    case("intrinsic-nested.zip", lambda s: _camera_matrix(s, [[[1]], [2, 3], "x"]), "bad-calibration"),
    case(
        "intrinsic-1e400.zip", lambda s: _camera_matrix(s, [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]), "bad-calibration"
    ),
    case("stamps-equal.zip", lambda s: _stamps(s, lambda n: 5), "time-order", end=SPOILT),
    case("stamps-decreasing.zip", lambda s: _stamps(s, lambda n: 10**15 - n * 10**6), "time-order", end=SPOILT),
    case("stamps-huge.zip", lambda s: _stamps(s, lambda n: 10**30 + n), TABLE, "sample"),
    case("stamps-nan.zip", lambda s: _stamps(s, lambda n: NAN), TABLE, "sample"),
    case("stamps-floats.zip", lambda s: _stamps(s, lambda n: n + 0.5), TABLE, "sample"),
    case("scan-outside.zip", _points_outside("../../../../etc/passwd"), "unsafe-path", "sample_data.json"),
    case("scan-absolute.zip", _points_outside("/etc/passwd"), "unsafe-path", "sample_data.json"),
    case("scan-nul.zip", _points_outside("samples/a\0b"), "unsafe-path", "sample_data.json"),
    case("scan-is-a-folder.zip", _points_outside("samples"), "missing-file truncated-scan", "samples"),
    case("scans-missing.zip", lambda s: s.without("LIDAR_TOP"), "missing-file", "LIDAR_TOP"),
    case("images-missing.zip", lambda s: s.without("CAM_"), "missing-file", "CAM_"),
    case("points-nan.zip", lambda s: s.with_points(lambda p: p * np.float32(NAN)), "non-finite-points", "LIDAR_TOP"),
    case("one-point-nan.zip", lambda s: s.with_points(_first_nan), "non-finite-points", "LIDAR_TOP"),
    case("points-inf.zip", lambda s: s.with_points(lambda p: p + np.float32(INF)), "non-finite-points", "LIDAR_TOP"),
    case("points-far.zip", lambda s: s.with_points(_times(1e20)), "implausible-points", "LIDAR_TOP"),
    case("points-few.zip", lambda s: s.with_points(lambda p: p[:3]), "truncated-scan", "LIDAR_TOP"),
    case("points-none.zip", lambda s: s.with_points(lambda p: p[:0]), "truncated-scan", "LIDAR_TOP"),
    case("png-of-60000.zip", lambda s: s.with_images(lambda _: _png(60_000, 60_000)), "bad-image", "CAM_"),
    case("png-of-2e9.zip", lambda s: s.with_images(lambda _: _png(2**31 - 1, 2**31 - 1)), "bad-image", "CAM_"),
    case("png-of-nothing.zip", lambda s: s.with_images(lambda _: _png(0, 0)), "bad-image", "CAM_"),
    case("png-wrong-crc.zip", lambda s: s.with_images(lambda _: _png(320, 180, good_crc=False)), "bad-image", "CAM_"),
    case("png-bomb.zip", lambda s: s.with_images(lambda _: _png(9000, 9000, data=bytes(1 << 20))), "wrong-image-size"),
    case("jpeg-of-65000.zip", lambda s: s.with_images(lambda c: _jpeg(c, 65_000, 65_000)), "bad-image", "CAM_"),
    case(
        "jpeg-of-another-size.zip", lambda s: s.with_images(lambda c: _jpeg(c, 5000, 4000)), "wrong-image-size", "CAM_"
    ),
    case("jpeg-cut.zip", lambda s: s.with_images(_without_end), "bad-image", "CAM_"),
    case("svg-image.zip", lambda s: s.with_images(lambda _: b"<svg onload='x'/>"), "bad-image", "CAM_"),
    case("truth-huge.zip", lambda s: _truth(s, _npy("(1000000000000,)")), "truth-length", "panoptic"),
    case("truth-objects.zip", lambda s: _truth(s, _npy("(10,)", "|O")), "bad-truth", "panoptic"),
    case("truth-code.zip", lambda s: _truth(s, _npy("__import__('os').getpid()")), "bad-truth", "panoptic"),
    case("truth-no-zip.zip", lambda s: _truth(s, b"\x80\x04pickle"), "bad-truth", "panoptic"),
    case("kitti-times-nan.zip", _kitti(_SCAN, "nan\nnan\nnan\n"), "bad-timestamps", "times.txt"),
    case("kitti-times-huge.zip", _kitti(_SCAN, "1e300\n1e301\n1e302\n"), "bad-timestamps", "times.txt"),
    case("kitti-calibration-text.zip", _kitti(_SCAN, "0\n1\n2\n", "P2: one two\n"), "missing-calibration", "calib.txt"),
]
