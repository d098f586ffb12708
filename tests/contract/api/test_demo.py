"""``l3ps demo`` as a user runs it, on a drive and a model of their own."""

import os
import subprocess
import sys


def test_the_demo_ends_in_tables_labels_and_pictures_and_leaves_no_service(drive_log, bundle, tmp_path):
    data = tmp_path / "demo"
    command = [sys.executable, "-m", "l3ps_cli.main", "demo", "--preset", "fast", "--data", data]
    command += ["--drive", drive_log, "--model", bundle]
    env = os.environ | {"COLUMNS": "150"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert result.returncode == 0, result.stderr
    assert "protocol nuscenes" in result.stdout
    for word in ("car", "mean", "refine", "cluster"):
        assert word in result.stdout
    (labels,) = (data / "labels").iterdir()
    assert len(list(labels.glob("refined/panoptic/*.npz"))) == 3
    for picture in ("class.png", "instance.png"):
        assert (data / picture).read_bytes().startswith(b"\x89PNG")
    assert not (data / "service" / "up.json").exists()
