"""poses.txt as KITTI's tools read it, and as we read it back."""

import numpy as np
import pytest

from l3ps.errors import LabelError
from l3ps.labels import read_poses, write_poses


def pose(x, y, yaw):
    m = np.eye(4)
    m[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    m[:2, 3] = x, y
    return m


def test_round_trip_over_two_scenes(make_scene, tmp_path):
    first, second = make_scene("scene with space", ["a", "b"]), make_scene("s2", ["c"])
    poses = np.stack([np.eye(4), pose(1234.5678901, -3e-7, 1.1)]), np.stack([pose(1, 2, -3)])
    write_poses(tmp_path, [(first, poses[0]), (second, poses[1])])
    read = read_poses(tmp_path)
    assert list(read) == ["a", "b", "c"]
    np.testing.assert_allclose(np.stack(list(read.values())), np.concatenate(poses), rtol=0, atol=1e-8)
    kitti = np.loadtxt(tmp_path / "poses.txt")
    assert kitti.shape == (3, 12)
    np.testing.assert_allclose(kitti[1].reshape(3, 4)[:, 3], [1234.5678901, -3e-7, 0], atol=1e-8)
    assert (tmp_path / "scans.txt").read_text().splitlines()[0] == "scene with space\ta"


def test_poses_must_match_the_scans(make_scene, tmp_path):
    scene = make_scene("s", ["a", "b"])
    with pytest.raises(ValueError, match="2 scans"):
        write_poses(tmp_path, [(scene, np.eye(4)[None])])
    with pytest.raises(ValueError, match="finite"):
        write_poses(tmp_path, [(scene, np.full((2, 4, 4), np.nan))])


@pytest.mark.parametrize(
    ("rows", "names", "message"),
    [
        (None, None, "cannot be read"),
        ("1 2 3\n", "s a\n", "no 12 numbers in row 1"),
        ("x " * 12 + "\n", "s a\n", "no 12 numbers in row 1"),
        ("", "s a\n", "0 rows where scans.txt has 1"),
    ],
)
def test_bad_pose_files(tmp_path, rows, names, message):
    if rows is not None:
        (tmp_path / "poses.txt").write_text(rows)
        (tmp_path / "scans.txt").write_text(names)
    with pytest.raises(LabelError, match=message):
        read_poses(tmp_path)
