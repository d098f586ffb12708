"""``l3ps bench segment`` as a user calls it."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from l3ps.drivelog import open_drive
from l3ps_cli.main import app


def bench(*options):
    return CliRunner().invoke(app, ["bench", "segment", *map(str, options)])


def test_the_whole_is_told_beside_the_session_alone(small_drive, write_bundle):
    options = ("--model", write_bundle(), "--images", small_drive, "--count", 5, "--rounds", 2, "--json")
    result = bench(*options)
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["model"], figures["input"], figures["count"], figures["passes"]) == ("colours", [64, 32], 5, 1)
    assert figures["distinct"] <= sum(len(scan.cameras) for scan in open_drive(small_drive).scenes[0].scans)
    assert set(figures["rates"]) == {"end_to_end", "bare", "bare_default_options", "bare_side_by_side"}
    for name, told in figures["rates"].items():
        assert len(figures["round_seconds"][name]) == 2
        assert told["images_per_second"] == pytest.approx(5 / sum(figures["round_seconds"][name]))
    assert set(figures["ratios"]) == set(figures["rates"]) - {"end_to_end"}
    assert list(figures["steps"]) == ["decode", "resize", "network", "label", "fuse"]
    assert sum(step["share"] for step in figures["steps"].values()) == pytest.approx(1)
    assert figures["peak_mb"] > figures["before_mb"] > 10


def test_a_plain_folder_of_images_does_and_tilings_are_several_passes(small_drive, write_bundle, tmp_path):
    (tmp_path / "images" / "front").mkdir(parents=True)
    (camera, *_) = open_drive(small_drive).scenes[0].scans[0].cameras
    shutil.copy(camera.path, tmp_path / "images" / "front")
    result = bench("--model", write_bundle(), "--images", tmp_path / "images", "--count", 2, "--segment", "paper")
    assert result.exit_code == 0, result.output
    assert "images/s" in result.stdout and "peak memory" in result.stdout


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--segment", "closer"), "there is no 'closer'"),
        (("--fusion", "glue"), "there is no 'glue'"),
        (("--images", "empty"), "there is no image in it"),
        (("--images", "nowhere"), "no such file"),
        (("--segment", "balanced"), "no graph for the preset 'balanced'"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(small_drive, write_bundle, tmp_path, monkeypatch, options, expected):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    result = bench("--model", write_bundle(), "--images", small_drive, "--count", 2, *options)
    assert result.exit_code == 2, result.output
    assert expected in " ".join(result.stderr.split())
    assert "Traceback" not in result.output
