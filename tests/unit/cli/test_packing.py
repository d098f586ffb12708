"""Logs and bundles made into single files: reproducible, complete, and refused with a sentence when they are none."""

import json
import os
import tarfile
import zipfile
from pathlib import Path

import pytest

from l3ps.errors import DriveLogError, ModelError
from l3ps_cli.packing import bundle_name, pack_bundle, pack_log, sha256_of

DESCRIPTION = {
    "name": "tiny",
    "input": {"name": "image", "height": 8, "width": 8},
    "output": {"semantic": "logits"},
    "classes": ["car"],
    "to_nuscenes": {"car": 4},
}


@pytest.fixture
def log(tmp_path) -> Path:
    root = tmp_path / "log"
    (root / "samples" / "LIDAR_TOP").mkdir(parents=True)
    (root / "samples" / "LIDAR_TOP" / "a.bin").write_bytes(b"points")
    (root / "v1.0-mini").mkdir()
    (root / "v1.0-mini" / "scene.json").write_text("[]")
    return root


@pytest.fixture
def bundle(tmp_path) -> Path:
    root = tmp_path / "bundle"
    root.mkdir()
    (root / "model.json").write_text(json.dumps(DESCRIPTION))
    (root / "model.onnx").write_bytes(b"graph")
    return root


def test_a_packed_log_holds_every_file_below_its_root(log, tmp_path):
    pack_log(log, tmp_path / "log.tar")
    with tarfile.open(tmp_path / "log.tar") as tar:
        content = {member.name: tar.extractfile(member).read() for member in tar}
    assert content == {"samples/LIDAR_TOP/a.bin": b"points", "v1.0-mini/scene.json": b"[]"}


def test_the_same_log_packs_to_the_same_bytes_whenever_it_was_copied(log, tmp_path):
    pack_log(log, tmp_path / "one.tar")
    os.utime(log / "v1.0-mini" / "scene.json", (1, 1))
    (log / "v1.0-mini" / "scene.json").chmod(0o600)
    pack_log(log, tmp_path / "two.tar")
    assert sha256_of(tmp_path / "one.tar") == sha256_of(tmp_path / "two.tar")


def test_links_travel_as_what_they_show_and_a_loop_of_links_ends(log, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "b.bin").write_bytes(b"more")
    (log / "sweeps").symlink_to(tmp_path / "elsewhere")
    (log / "samples" / "loop").symlink_to(log)
    pack_log(log, tmp_path / "log.tar")
    with tarfile.open(tmp_path / "log.tar") as tar:
        members = {member.name: member.isfile() for member in tar}
    assert members.pop("sweeps/b.bin")
    assert set(members) == {"samples/LIDAR_TOP/a.bin", "v1.0-mini/scene.json"}


def test_an_empty_log_is_refused(tmp_path):
    (tmp_path / "log").mkdir()
    with pytest.raises(DriveLogError, match="holds no files"):
        pack_log(tmp_path / "log", tmp_path / "log.tar")


def test_a_packed_bundle_is_a_bundle_whichever_name_its_description_had(bundle, tmp_path):
    (bundle / "model.json").rename(bundle / "about.json")
    pack_bundle(bundle, tmp_path / "bundle.zip")
    assert sorted(zipfile.ZipFile(tmp_path / "bundle.zip").namelist()) == ["model.json", "model.onnx"]
    assert bundle_name(bundle) == bundle_name(tmp_path / "bundle.zip") == "tiny"


def test_a_directory_without_a_network_is_no_bundle(bundle):
    (bundle / "model.onnx").unlink()
    with pytest.raises(ModelError, match=r"model\.onnx"):
        bundle_name(bundle)
