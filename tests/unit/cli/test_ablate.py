"""``l3ps ablate`` as a user calls it, and the variants it compares."""

import json
import shutil

from typer.testing import CliRunner

from l3ps.presets import BEST, PAPER
from l3ps_cli.ablate import variants
from l3ps_cli.main import app


def run(*arguments):
    return CliRunner().invoke(app, ["ablate", *[str(argument) for argument in arguments]])


def test_each_component_of_best_is_taken_away_once():
    without = {row.name.removeprefix("best, paper's "): row.preset for row in variants(sizes=False)}
    assert without.pop("paper") == PAPER
    assert without.pop("best") == BEST
    assert without["instances"].instances == PAPER.instances
    for name, preset in without.items():
        assert preset not in (BEST, PAPER), f"{name} changes nothing, or more than itself"
    assert len(set(without.values())) == len(without)


def test_the_papers_cluster_sizes_are_among_the_variants():
    sizes = {row.preset.min_cluster_size for row in variants() if row.name.startswith("paper, ")}
    assert sizes == {3, 5, 10, 20, 50}


def test_figures_of_every_variant_beside_the_primal_labels(small_drive):
    result = run("--log", small_drive, "--log", small_drive, "--no-sizes", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["protocol"] == "nuscenes"
    first, second = figures["logs"]
    assert [row["variant"] for row in first["rows"]] == ["primal", *(row.name for row in variants(sizes=False))]
    primal, paper, *_ = first["rows"]
    assert primal["worst_iou_change"] == 0
    assert paper["miou"] != primal["miou"]
    assert 0 < paper["pq"] < 100
    for one, other in zip(first["rows"], second["rows"], strict=True):
        assert one["classes"] == other["classes"], "the same log scores the same"


def test_a_log_without_truth_is_refused_by_name(small_drive, tmp_path):
    bare = shutil.copytree(small_drive, tmp_path / "bare")
    for name in ("panoptic", "lidarseg"):
        (bare / "v1.0-mini" / f"{name}.json").unlink(missing_ok=True)
    result = run("--log", bare, "--no-sizes")
    assert result.exit_code == 2
    assert "bare: it holds no truth" in " ".join(result.output.split())


def test_an_unknown_scene_is_refused_with_the_known_ones(small_drive):
    result = run("--log", small_drive, "--scene", "nowhere")
    assert result.exit_code == 2
    assert "has no scene 'nowhere'" in " ".join(result.output.split())


def test_an_unknown_protocol_is_refused(small_drive):
    result = run("--log", small_drive, "--protocol", "mine")
    assert result.exit_code == 2
    assert "there is no 'mine'" in result.output


def test_threads_that_no_machine_has_are_refused(small_drive):
    result = run("--log", small_drive, "--threads", 20_000)
    assert result.exit_code == 2
    assert "less than or equal to 256" in " ".join(result.output.split())
