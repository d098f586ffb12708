"""Which layout a folder has."""

import shutil

import pytest

from l3ps.drivelog import open_drive
from l3ps.errors import DriveLogError


@pytest.fixture
def logs(nuscenes_log, kitti_raw_log, semantickitti_log):
    return {"nuscenes": nuscenes_log().root, "kitti-raw": kitti_raw_log(), "semantickitti": semantickitti_log()}


@pytest.mark.parametrize("layout", ["nuscenes", "kitti-raw", "semantickitti"])
@pytest.mark.parametrize("depth", [0, 1, 2])
def test_log_in_folders_that_hold_nothing_else(logs, tmp_path, layout, depth):
    outer = tmp_path / "outer"
    inner = outer.joinpath(*["wrapped"] * depth)
    shutil.copytree(logs[layout], inner)
    (outer / "README.txt").write_text("how it was recorded")
    (outer / "__MACOSX" / "v1.0-mini").mkdir(parents=True)
    (outer / ".git").mkdir()
    drive = open_drive(outer)
    assert drive.format == layout
    assert drive.root == inner.resolve()


def test_parts_of_a_log(logs):
    day = logs["kitti-raw"] / "2011_09_26"
    for part in (day, day / "2011_09_26_drive_0000_sync"):
        assert [s.name for s in open_drive(part).scenes] == ["2011_09_26_drive_0000_sync"]
    for part in (logs["semantickitti"] / "sequences", logs["semantickitti"] / "sequences" / "00"):
        assert [s.name for s in open_drive(part).scenes] == ["00"]
    assert open_drive(logs["nuscenes"] / "v1.0-mini").root == logs["nuscenes"]


def test_of_several_versions_one_must_be_named(logs):
    root = logs["nuscenes"]
    shutil.copytree(root / "v1.0-mini", root / "v1.0-test")
    with pytest.raises(DriveLogError, match=r"2 sets of tables \(v1.0-mini, v1.0-test\)"):
        open_drive(root)
    assert len(open_drive(root / "v1.0-test").scenes) == 1


def test_folder_of_a_version_without_tables_does_not_count(logs):
    """Archives of single parts leave such folders behind, e.g. with maps only."""
    (logs["nuscenes"] / "v1.0-test").mkdir()
    assert len(open_drive(logs["nuscenes"]).scenes) == 1


def test_no_log_says_what_was_looked_for(tmp_path):
    (tmp_path / "images").mkdir()
    with pytest.raises(DriveLogError) as caught:
        open_drive(tmp_path)
    (problem,) = caught.value.problems
    assert problem.code == "no-log"
    assert "no LiDAR log found: looked for v1.0-*/scene.json, */velodyne_points, sequences/*/velodyne" in problem.what


def test_no_such_folder(tmp_path):
    with pytest.raises(DriveLogError, match="there is no such file or folder"):
        open_drive(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DriveLogError, match="it is a file"):
        open_drive(tmp_path / "file")


def test_velodyne_folder_without_scans(kitti_raw_log, semantickitti_log):
    for root in (kitti_raw_log(), semantickitti_log()):
        for path in root.rglob("*.bin"):
            path.unlink()
        with pytest.raises(DriveLogError) as caught:
            open_drive(root)
        assert [p.code for p in caught.value.problems] == ["no-scans"]
