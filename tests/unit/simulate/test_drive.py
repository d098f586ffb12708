"""The written drive is a whole nuScenes log whose truth is true."""

import json

import cv2
import numpy as np
import pytest

from l3ps.drivelog import open_drive
from l3ps.simulate.nuscenes_tables import VERSION, quaternion
from l3ps.simulate.parts import turn
from l3ps.taxonomy import NUSCENES16


@pytest.fixture(scope="session")
def tables(simulated):
    return {path.stem: json.loads(path.read_text()) for path in (simulated / VERSION).glob("*.json")}


@pytest.fixture(scope="session")
def scans(simulated):
    return open_drive(simulated).scenes[0].scans


def pose(row):
    """(4, 4) from a row's quaternion and translation."""
    w, x, y, z = row["rotation"]
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = row["translation"]
    return matrix


def test_every_token_resolves(tables):
    known = {name: {row["token"] for row in rows} for name, rows in tables.items()}
    for name, rows in tables.items():
        assert len(known[name]) == len(rows), f"{name} repeats a token"
        for row in rows:
            for column, value in row.items():
                if column in ("prev", "next"):
                    assert value == "" or value in known[name]
                elif column.endswith(("_token", "_tokens")):
                    target = column.removesuffix("_tokens").removesuffix("_token")
                    target = {"first_sample": "sample", "last_sample": "sample"}.get(target, target)
                    target = "sample_annotation" if target.endswith("_annotation") else target
                    for token in value if isinstance(value, list) else [value]:
                        assert token in known[target], f"{name}.{column}"


def test_chains_are_closed_and_in_time_order(tables):
    for name in ("sample", "sample_data", "sample_annotation"):
        rows = {row["token"]: row for row in tables[name]}
        for row in rows.values():
            if row["prev"]:
                assert rows[row["prev"]]["next"] == row["token"]
            if row["next"]:
                assert rows[row["next"]]["prev"] == row["token"]
                if "timestamp" in row:
                    assert rows[row["next"]]["timestamp"] > row["timestamp"]
    assert sum(row["prev"] == "" for row in tables["sample"]) == 1
    assert sum(row["prev"] == "" for row in tables["sample_data"]) == 7
    for row in tables["instance"]:
        chain = [row["first_annotation_token"]]
        rows = {r["token"]: r for r in tables["sample_annotation"]}
        while rows[chain[-1]]["next"]:
            chain.append(rows[chain[-1]]["next"])
        assert (chain[-1], len(chain)) == (row["last_annotation_token"], row["nbr_annotations"])


def test_every_file_is_there_and_labels_match_points(simulated, tables, scans):
    for table in ("sample_data", "lidarseg", "panoptic", "map"):
        assert all((simulated / row["filename"]).stat().st_size for row in tables[table])
    assert len(scans) == 3
    for scan in scans:
        points, truth = scan.load_points(), scan.load_truth()
        lidarseg = np.fromfile(simulated / f"lidarseg/{VERSION}/{scan.token}_lidarseg.bin", np.uint8)
        panoptic = np.load(simulated / f"panoptic/{VERSION}/{scan.token}_panoptic.npz")["data"]
        assert len(points) == len(truth.semantic) == len(lidarseg) == len(panoptic)
        assert (panoptic // 1000 == lidarseg).all()
        assert len(scan.cameras) == 6


def test_declared_image_size_is_the_images_own(simulated, tables):
    for row in tables["sample_data"]:
        if row["fileformat"] == "jpg":
            assert cv2.imread(str(simulated / row["filename"])).shape == (row["height"], row["width"], 3)


def test_boxes_hold_the_points_of_their_object_and_ids_last_a_scene(tables, scans):
    """Points of an instance lie in one annotated box, and in the same instance's box at every scan."""
    instance_of = {}
    data = {row["token"]: row for row in tables["sample_data"]}
    for scan in scans:
        xyz, truth = scan.load_points().xyz, scan.load_truth()
        to_world = scan.ego_to_world @ scan.lidar_to_ego
        world = xyz @ to_world[:3, :3].T + to_world[:3, 3]
        inside_any = np.zeros(len(world), bool)
        for row in tables["sample_annotation"]:
            if row["sample_token"] != data[scan.token]["sample_token"]:
                continue
            center, (width, length, height) = pose(row), row["size"]
            local = (world - center[:3, 3]) @ center[:3, :3]
            inside = (np.abs(local) <= np.array([length, width, height]) / 2).all(axis=1)
            assert abs(int(inside.sum()) - row["num_lidar_pts"]) <= 1
            ids = np.unique(truth.instance[inside & (truth.instance > 0)])
            if len(ids) == 1 and inside.sum() > 5:
                assert instance_of.setdefault(row["instance_token"], int(ids[0])) == ids[0]
            grown = np.array([length, width, height]) / 2 + 0.1  # range noise
            inside_any |= (np.abs(local) <= grown).all(axis=1)
        things = NUSCENES16.is_thing[truth.semantic]
        assert ((truth.instance > 0) == things).all()
        assert inside_any[things].mean() > 0.99
    assert len(set(instance_of.values())) == len(instance_of) > 10


def test_points_and_pixels_agree_but_for_parallax(simulated, scans):
    """Labels looked up through the log's own calibration: nine of ten right; the rest is seen past an edge."""
    right, total, of_things, same_object = 0, 0, 0, 0
    for scan in scans:
        xyz, truth = scan.load_points().xyz, scan.load_truth()
        for camera in scan.cameras:
            image = cv2.imread(
                str(simulated / "image_truth" / camera.channel / f"{camera.path.stem}.png"), cv2.IMREAD_UNCHANGED
            )
            transform = scan.lidar_to_camera(camera)
            seen = xyz @ transform[:3, :3].T + transform[:3, 3]
            depth = np.where(seen[:, 2] > 1, seen[:, 2], 1)
            pixel = np.floor((seen @ camera.intrinsic.T)[:, :2] / depth[:, None]).astype(int)
            height, width = image.shape
            inside = (seen[:, 2] > 1) & (pixel >= 1).all(axis=1) & (pixel < [width - 1, height - 1]).all(axis=1)
            inside &= truth.semantic > 0
            found = image[pixel[inside, 1], pixel[inside, 0]]
            agree = found // 1000 == truth.semantic[inside]
            things = agree & (truth.instance[inside] > 0)
            right, total = right + int(agree.sum()), total + len(agree)
            same_object += int((found % 1000 == truth.instance[inside] % 1000)[things].sum())
            of_things += int(things.sum())
    assert total > 20_000
    assert 0.9 < right / total < 0.995  # parallax must leave its mark
    assert same_object / of_things > 0.95


def test_cameras_fire_at_their_own_times_from_their_own_places(scans):
    for scan in scans:
        stamps = {camera.timestamp for camera in scan.cameras}
        assert len(stamps) == 6
        assert all(-50_000 < stamp - scan.timestamp <= 5_000 for stamp in stamps)
        for camera in scan.cameras:
            distance = np.linalg.norm((np.linalg.inv(scan.lidar_to_ego) @ camera.camera_to_ego)[:3, 3])
            assert 0.4 < distance < 1.2


def test_quaternions_give_back_their_rotation():
    for angles in [(0, 0, 0), (3.1, 0.1, -0.2), (-1.6, 1.2, 3.0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi)]:
        rotation = turn(*angles)
        row = {"rotation": quaternion(rotation), "translation": [0, 0, 0]}
        np.testing.assert_allclose(pose(row)[:3, :3], rotation, atol=1e-12)
