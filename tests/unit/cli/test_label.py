"""``l3ps label``, ``l3ps bench`` and ``l3ps simulate`` as a user calls them."""

import importlib.util
import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from l3ps.drivelog import open_drive
from l3ps.labels import open_labels, read_poses
from l3ps_cli.main import app


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def files_under(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def bundle(write_bundle):
    return write_bundle()


def test_a_drive_gets_labels_poses_and_a_report(small_drive, bundle, tmp_path):
    out, report = tmp_path / "out", tmp_path / "reports" / "run.json"
    result = run("label", small_drive, "--model", bundle, "--out", out, "--report", report, "--preset", "paper")
    assert result.exit_code == 0, result.output
    assert "mean" in result.stdout
    drive = open_drive(small_drive)
    (scene,) = drive.scenes
    for side in ("primal", "refined"):
        folder = open_labels(out / side)
        for scan in scene.scans:
            semantic, _ = folder.read(scene, scan, "nuscenes")
            assert len(semantic) == len(scan.load_points())
            assert semantic.any()
    assert list(read_poses(out)) == [scan.token for scan in scene.scans]
    summary = json.loads(report.read_text())
    assert summary["preset"]["name"] == "paper"
    assert set(summary["quality"]) == {"primal", "refined"}
    assert set(summary["scenes"][0]["stages"]) == {"segment", "accumulate", "ground", "cluster", "vote", "instances"}
    told = summary["scenes"][0]
    assert [row["token"] for row in told["estimates"]] == [scan.token for scan in scene.scans]
    assert all(0 <= row["estimate"] <= 1 and row["pq"] is not None for row in told["estimates"])
    assert told["rank_correlation"] is None, "two scans have no ranks worth the name"
    assert told["poses"]["source"] == "kiss-icp", "as published"
    assert told["points"] == sum(len(scan.load_points()) for scan in scene.scans)


def test_poses_that_the_scans_contradict_are_told_and_reported(small_drive, bundle, tmp_path):
    drive, report = tmp_path / "drive", tmp_path / "run.json"
    shutil.copytree(small_drive, drive)
    (table,) = drive.glob("v1.0-*/ego_pose.json")
    rows = json.loads(table.read_text())
    table.write_text(json.dumps([row | {"translation": [0, 0, 0]} for row in rows]))
    result = run("label", drive, "--model", bundle, "--out", tmp_path / "o", "--report", report)
    assert result.exit_code == 0, result.output
    assert "under the log's poses" in result.stderr
    (told,) = json.loads(report.read_text())["scenes"]
    assert [problem["code"] for problem in told["warnings"]] == ["inconsistent-poses"]
    assert (told["poses"]["source"], told["poses"]["parts"]) == ("kiss-icp", 1)
    assert told["poses"]["residual"] < 0.5


def test_the_same_input_gives_the_same_bytes(small_drive, bundle, tmp_path):
    for name in ("a", "b"):
        assert run("label", small_drive, "--model", bundle, "--out", tmp_path / name).exit_code == 0
    assert files_under(tmp_path / "a") == files_under(tmp_path / "b")


def test_a_second_run_replaces_the_first(small_drive, bundle, tmp_path):
    for label_format in ("nuscenes", "semantickitti"):
        result = run("label", small_drive, "--model", bundle, "--out", tmp_path / "o", "--format", label_format)
        assert result.exit_code == 0, result.output
    assert not list((tmp_path / "o").rglob("*_panoptic.npz"))
    refined = tmp_path / "o" / "refined" / "sequences"
    assert len(list(refined.rglob("*.label"))) == len(list(refined.rglob("*_confidence.npz"))) == 2


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--preset", "great"), "there is no 'great'"),
        (("--format", "coco"), "there is no 'coco'"),
        (("--scene", "scene-99"), "no scene 'scene-99'"),
        (("--model", "nowhere"), "there is no such file or directory"),
    ],
)
def test_a_wrong_option_is_one_sentence_and_leaves_nothing(small_drive, bundle, tmp_path, options, expected):
    result = run("label", small_drive, "--model", bundle, "--out", tmp_path / "o", *options)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "Traceback" not in result.output
    assert not (tmp_path / "o").exists()


@pytest.fixture
def spoilt_drive(small_drive, tmp_path):
    """The second scan is cut short."""
    copy = tmp_path / "spoilt"
    shutil.copytree(small_drive, copy)
    scan = open_drive(copy).scenes[0].scans[1]
    scan.path.write_bytes(scan.path.read_bytes()[:-3])
    return copy, scan


def test_a_bad_scan_is_named_and_stops_the_run_unless_asked(spoilt_drive, bundle, tmp_path):
    drive, scan = spoilt_drive
    out = tmp_path / "o"
    refused = run("label", drive, "--model", bundle, "--out", out)
    assert refused.exit_code == 2
    assert scan.path.name in refused.stderr
    assert not out.exists()
    kept = run("label", drive, "--model", bundle, "--out", out, "--skip-bad-scans")
    assert kept.exit_code == 0, kept.output
    assert scan.path.name in kept.stderr
    assert len(list((out / "refined" / "panoptic").iterdir())) == 1


def test_what_was_there_survives_a_failed_run(small_drive, spoilt_drive, bundle, tmp_path):
    out = tmp_path / "o"
    assert run("label", small_drive, "--model", bundle, "--out", out).exit_code == 0
    before = files_under(out)
    assert run("label", spoilt_drive[0], "--model", bundle, "--out", out).exit_code == 2
    assert files_under(out) == before


def test_bench_tells_every_stage_and_its_peers(small_drive):
    result = run("bench", "refine", "--log", small_drive, "--scans", 1, "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["scans"] == 1
    assert set(figures["stages"]) == {"accumulate", "ground", "cluster", "vote", "instances"}
    for cost in figures["stages"].values():
        assert cost["seconds"] >= 0 and cost["peak_mb"] > 10
        assert cost["bytes_a_point"] == pytest.approx(cost["growth_mb"] * 2**20 / figures["points"])
    assert figures["peak_mb"] == max(cost["peak_mb"] for cost in figures["stages"].values())
    assert figures["bytes_a_point"] > 12, "the accumulated points alone take so much"
    assert set(figures["clustering"]) == {"l3ps", "fast_hdbscan", "hdbscan"}
    assert figures["clustering"]["l3ps"] > 0
    for name in ("fast_hdbscan", "hdbscan"):
        seconds, ratio = figures["clustering"][name], figures["ratios"][f"clustering_vs_{name}"]
        if importlib.util.find_spec(name) is None:
            assert seconds is None and ratio is None
        else:
            assert ratio == pytest.approx(seconds / figures["clustering"]["l3ps"])
    drive = open_drive(small_drive)
    sizes = [len(scan.load_points()) for scan in drive.scenes[0].scans]
    assert [(row["scans"], row["points"]) for row in figures["growth"]] == [(1, sizes[0]), (2, sum(sizes))]
    first, last = figures["growth"][0], figures["growth"][-1]
    assert last["us_a_point"] == pytest.approx(1e6 * last["seconds"] / last["points"])
    assert figures["ratios"]["growth_1_to_max"] == pytest.approx(last["us_a_point"] / first["us_a_point"])


def test_bench_leaves_out_what_it_is_told_to(small_drive):
    result = run("bench", "refine", "--log", small_drive, "--scans", 1, "--no-peers", "--no-growth", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["growth"] == []
    assert figures["clustering"]["l3ps"] > 0
    assert (figures["clustering"]["hdbscan"], figures["clustering"]["fast_hdbscan"]) == (None, None)
    assert set(figures["ratios"].values()) == {None}


@pytest.mark.parametrize(
    ("options", "expected"),
    [(("--scene", "x"), "no scene 'x'"), (("--preset", "x"), "no 'x'"), (("--log", "nowhere"), "no such file")],
)
def test_bench_refuses_in_one_sentence(small_drive, options, expected):
    result = run("bench", "refine", "--log", small_drive, "--no-peers", *options)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "Traceback" not in result.output and "Usage" not in result.output


def test_bench_says_which_scan_cannot_be_refined(spoilt_drive):
    drive, scan = spoilt_drive
    result = run("bench", "refine", "--log", drive, "--no-peers", "--no-growth")
    assert result.exit_code == 2
    assert scan.token in result.stderr
    assert "Traceback" not in result.output


def test_simulate_makes_a_drive_and_touches_no_folder_in_use(tmp_path):
    result = run("simulate", "--scans", 1, "--seed", 4, "--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    scan = open_drive(tmp_path / "new").scenes[0].scans[0]
    assert np.isfinite(scan.load_points().xyz).all()
    again = run("simulate", "--out", tmp_path / "new")
    assert again.exit_code == 2
    assert "not an empty folder" in again.stderr


def test_files_of_the_user_in_the_way_are_not_deleted(small_drive, bundle, tmp_path):
    notes = tmp_path / "o" / "refined" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("precious")
    result = run("label", small_drive, "--model", bundle, "--out", tmp_path / "o")
    assert result.exit_code == 2
    assert "notes.txt" in result.stderr
    assert files_under(tmp_path / "o") == {"refined/notes.txt": b"precious"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("label", "--protocol", "foo"), "there is no 'foo'"),
        (("label", "--report", "/dev/null/report.json"), "/dev/null"),
        (("label", "--out", "/dev/null/labels"), "/dev/null"),
        (("bench", "refine", "--preset", "foo"), "there is no 'foo'"),
    ],
)
def test_what_cannot_work_is_said_before_the_work(small_drive, bundle, tmp_path, arguments, expected):
    command, *options = arguments
    if command == "label":
        options = [small_drive, "--model", bundle, "--out", tmp_path / "o", *options]
    else:
        options = [*options, "--log", small_drive]
    result = run(command, *options)
    assert result.exit_code == 2, result.output
    assert expected in result.stderr
    assert not isinstance(result.exception, OSError | KeyError | ValueError)


def test_a_report_that_is_a_folder_is_refused_before_the_work(small_drive, bundle, tmp_path):
    result = run("label", small_drive, "--model", bundle, "--out", tmp_path / "o", "--report", tmp_path)
    assert result.exit_code == 2
    assert "Is a directory" in result.stderr
    assert not (tmp_path / "o").exists()


def test_a_protocol_that_the_truth_cannot_serve_is_refused_before_the_work(small_drive, bundle, tmp_path):
    result = run("label", small_drive, "--model", bundle, "--out", tmp_path / "o", "--protocol", "semantickitti")
    assert result.exit_code == 2
    assert "which protocol semantickitti cannot score" in " ".join(result.stderr.split())
    assert "segment" not in result.stderr, "no image was looked at"
